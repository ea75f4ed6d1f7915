"""The base class of the project's systems."""

from pydrake.systems.framework import EventStatus
from pydrake.systems.framework import LeafSystem as DrakeLeafSystem

# What events return, made once.
DID_NOTHING = EventStatus.DidNothing()
SUCCEEDED = EventStatus.Succeeded()


class LeafSystem(DrakeLeafSystem):
    """Drake's LeafSystem, without witness functions.

    After each event Drake asks every system for them, and the binding looks
    for a Python override. If there is no attribute of that name an
    AttributeError is raised and dropped, every time, which took 6 % of the
    time of a run. If there is one that is not Python's, the binding remembers
    that nothing is overridden; any would do.
    """

    DoGetWitnessFunctions = DrakeLeafSystem.get_name
