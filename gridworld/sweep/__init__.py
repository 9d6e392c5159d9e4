"""Sweeps: many runs by one command line, in one folder, which the same command line goes on with.

    plan.py          a command line -> its jobs, each with a folder's name and a hash of its settings
    config_loader.py composes the jobs' configurations
    folder.py        the sweep's folder: sweep.json, and the lock of the process that runs the sweep
    job_table.py     jobs.csv: how each job stands, repaired by the jobs' own folders
    job.py           one job, in the process that the launcher runs it in
    console.py       terminal output at the start and at the end
    progress.py      the progress line on the terminal
    sweeper.py       a sweep from its command line to its exit code
    population.py    the jobs that train together, or in forks
    launchers/       which launcher runs the jobs (select.py); on_forks.py, on_joblib.py, ...; worker.py
    hydra_plugin.py  the plugins for Hydra

The jobs' folders decide: a run's manifest says how it ended, and a lock that ends with its process says that
it is running. The table follows from these, so that it can be repaired after a kill.
"""
