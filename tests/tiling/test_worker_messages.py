"""What workers log is said by the process that started them."""

import logging

from sc3d.settings.common import Workers
from sc3d.tiling.executor import open_executor


def warn(number: int) -> int:
    logging.getLogger("sc3d.of.a.worker").warning("photo %d is \x1b[31mred", number)
    return number


def test_messages_of_workers_reach_the_log_of_the_process_that_started_them(caplog, capfd):
    with open_executor(Workers(workers=1)) as executor:
        assert executor.run("warning", warn, [3, 4]) == [3, 4]
    found = [(record.name, record.levelname, record.getMessage()) for record in caplog.records]
    assert found == [("sc3d.of.a.worker", "WARNING", f"photo {number} is \x1b[31mred") for number in (3, 4)]
    assert "red" not in capfd.readouterr().err  # where it would not be freed of control characters
