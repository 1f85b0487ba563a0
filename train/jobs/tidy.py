"""Removes the fork server's temporary folder when the server ends, for `jobs.processes`.

The program that starts the server makes the folder and removes it, unless it is killed. The server
outlives it by a moment, and imports this module.
"""

import atexit
import os
import shutil

FOLDER = "MJCOLLECT_FORK_SERVER_FOLDER"  # Only the server has this in its environment.

if FOLDER in os.environ:
    atexit.register(shutil.rmtree, os.environ[FOLDER], ignore_errors=True)
