from hypothesis import settings

# A machine that is busy is no failure: what must be fast has a benchmark.
settings.register_profile("zencell", deadline=None)
settings.load_profile("zencell")
