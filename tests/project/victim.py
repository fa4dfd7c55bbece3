"""A process that edits a project, says so after each edit, and is killed by its parent.

Arguments: the project's path, a seed.
"""

import itertools
import sys
from pathlib import Path

from project_model import IDENTITY, act

from carts_core.project import Project

project = Project(IDENTITY, Path(sys.argv[1]))
assert project.writable
print("ready", flush=True)
for number in itertools.count():
    act(int(sys.argv[2]), number, project)
    print(number, flush=True)
