"""Sweeps: many runs by one command line, in one folder that can be come back to.

    plan.py       a command line -> its jobs, each with a folder's name and a hash of what matters
    folder.py     the sweep's folder: sweep.json, who is at work in it
    table.py      jobs.csv: how each job stands, put right from the jobs' own folders
    job.py        one job, in whichever process the launcher chose
    progress.py   the line on the terminal
    sweeper.py    all of it together, between Hydra's command line and Hydra's launcher
    launchers.py  which launcher runs the jobs, and whether it can
    worker.py     jobs in a process that a launcher started: parallel.py, on_slurm.py, on_ray.py
    hydra_plugin.py   what Hydra sees of it

Truth lies in the jobs' folders: a run's manifest says how it ended, a lock that dies with its process says
that it is at work. The table follows from these, so that it can be put right after a kill.
"""
