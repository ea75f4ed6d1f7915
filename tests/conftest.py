"""Settings of all tests."""

from hypothesis import settings

# The first call of a kernel compiles it: no deadline on single examples.
settings.register_profile("tofssm", deadline=None)
settings.load_profile("tofssm")
