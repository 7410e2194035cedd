import pytest

from deepracer_exp.aws.logs.reader import read_recording
from deepracer_exp.reports.tables.log_view import LogView, prepare
from tests.conftest import REFERENCE

CONSOLE = REFERENCE / "console_training"


@pytest.fixture(scope="session")
def console() -> LogView:
    """A recorded training of the AWS console."""
    if not CONSOLE.is_dir():
        pytest.skip("no recorded training of the console is there")
    return prepare(read_recording(CONSOLE))
