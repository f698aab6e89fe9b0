import pytest
from hypothesis import settings
from support import sized

# derandomize: the same examples every run, so a hypothesis test cannot fail by chance
settings.register_profile("house", deadline=None, derandomize=True, database=None, max_examples=sized(60, 15))
settings.load_profile("house")

# rooms of studies/ whose tests run processes, files, pages and clusters around the same few kernels; CI's run without
# the compiler, which takes coverage of hpgr, leaves them out
PLUMBING = {
    "test_accuracy",
    "test_cases",
    "test_cf",
    "test_cluster",
    "test_command_lines",
    "test_docs",
    "test_explore",
    "test_netcdf",
    "test_paper",
    "test_pictures",
    "test_pilot",
    "test_plots",
    "test_ready",
    "test_recorded",
    "test_report",
    "test_resume",
}


def pytest_collection_modifyitems(items):
    for item in items:
        if item.module.__name__ in PLUMBING:
            item.add_marker(pytest.mark.plumbing)


@pytest.fixture(scope="session")
def client():
    """A dask cluster of one thread in this process."""
    from studies.sweep.run import own_client

    with own_client(1) as own:
        yield own
