"""Sweeps: many runs by one command line, in one folder, which the same command line resumes.

    plan.py       a command line -> its jobs, each with its configuration and a hash; which train together
    folder.py     the sweep's folder: sweep.json, jobs.csv, and the lock of the process that runs the sweep
    sweeper.py    a sweep from its command line to its exit code
    job.py        one job and a population, in the process that they run in
    launchers/    where they run: on this machine, slurm.py, ray.py
    console.py    terminal output, with the table of results
    hydra_plugin.py    the plugin for Hydra

The jobs' folders decide: a run's manifest says how it ended, and a lock that ends with its process says that
it is running. The table follows from these.
"""
