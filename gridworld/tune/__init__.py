"""Tuning: search an agent's settings for what is certified on most seeds, and soonest, by Optuna.

    space.py     conf/tune/*.yaml -> what may be chosen, and a choice put into a configuration
    asked.py     a command line -> the configuration to begin from, and how to search
    score.py     what several seeds come to, as one number
    trial.py     one trial: train on each seed in memory, stop what cannot win
    storage.py   the study, where several processes and machines find it
    claim.py     whose the study's folder is
    worker.py    a process that runs trials until there are enough
    crew.py      several of them, watched
    records.py   trials.csv and study.json: what a reader needs, without Optuna
    finals.py    the best few again on more seeds, to choose the winner
    confirm.py   the winner beside the configuration it began from, on seeds that neither was chosen by
    verdict.py   which of the two is better
    recipe.py    the winner as a yaml for train.py

Truth lies in Optuna's storage; the files in the study's folder follow from it. Workers talk to the storage
only, so it does not matter which machine they are on.
"""
