import pytest
from hypothesis import settings
from support import sized

# derandomize: the same examples every run, so a hypothesis test cannot fail by chance
settings.register_profile("house", deadline=None, derandomize=True, database=None, max_examples=sized(60, 15))
settings.load_profile("house")

# rooms of studies/ whose tests run processes, files, pages and clusters around the same few kernels; CI's run without
# the compiler, which takes coverage of hpgr, leaves them out
PLUMBING = (
    "accuracy cases cf cluster command_lines docs explore netcdf optimum paper pictures pilot plant plots ready "
    "recorded report resume sensitivity space"
)


def pytest_collection_modifyitems(items):
    for item in items:
        if item.module.__name__.removeprefix("test_") in PLUMBING.split():
            item.add_marker(pytest.mark.plumbing)


@pytest.fixture(scope="session")
def client():
    """A dask cluster of one thread in this process."""
    from studies.sweep.run import own_client

    with own_client(1) as own:
        yield own
