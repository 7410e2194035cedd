from tests.training.conftest import workers_start_early  # noqa: F401 - a fixture
