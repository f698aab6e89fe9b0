from hypothesis import settings
from support import sized

# derandomize: the same examples every run, so a hypothesis test cannot fail by chance
settings.register_profile("house", deadline=None, derandomize=True, database=None, max_examples=sized(60, 15))
settings.load_profile("house")
