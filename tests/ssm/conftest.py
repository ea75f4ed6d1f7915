from hypothesis import settings

# The first call compiles: no deadline on single examples.
settings.register_profile("tofssm", deadline=None)
settings.load_profile("tofssm")
