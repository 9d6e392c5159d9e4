"""Tuning: search an agent's settings for those certified on most seeds, and soonest, by Optuna.

study_spec.py                    a command line -> the configuration to begin from, and how to search
study.py                         a study from its beginning to its verdict, and its folder
search.py, objective.py          the study in its database; trials, and what their settings come to
confirmation.py                  the best few on more seeds; the winner on seeds that nothing was chosen by
"""
