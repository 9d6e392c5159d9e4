#!/usr/bin/env bash
# Gradescope calls this once, as root, when it builds the container's image.
set -e
apt-get install -y python3-venv
python3 -m venv /autograder/venv
/autograder/venv/bin/pip install /autograder/source/gridworld_sb3-*.whl
