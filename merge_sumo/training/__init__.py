"""Training of the POV library: rewards, environments, DDQN, the helix, and their checks."""

from importlib.util import find_spec

from merge_sumo.errors import UserError

for _package in ("torch", "gymnasium", "pygame"):
    if find_spec(_package) is None:
        raise UserError(
            f"training needs {_package}, which is not installed: run "
            "`pip install 'merge-sumo[train]'`"
        )
