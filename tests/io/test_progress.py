"""Progress in files and pipes: what the lines say and when they come, by a clock that the test turns; where messages go."""

import io
import logging
import os
import re
import sys
from pathlib import Path

import pytest

import sc3d
from sc3d.errors import InputError
from sc3d.io import messages, progress
from sc3d.io.progress import INTERVAL, Board, Progress, duration, polled, under_way

CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def board(clock, caplog):
    """A board whose lines the test asks for: its own thread waits for half a minute of real time."""
    caplog.set_level(logging.INFO, logger="sc3d")
    return Board(clock)


@pytest.fixture
def logs():
    """Logging as it was, afterwards."""
    root = logging.getLogger()
    before, levels = list(root.handlers), {name: logging.getLogger(name).level for name in messages.PACKAGES}
    yield root
    messages.start_logging()
    logging.captureWarnings(False)
    root.handlers[:] = before
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def lines(caplog):
    return [record.getMessage() for record in caplog.records if record.name == progress.__name__]


def test_a_line_every_30_seconds_with_stage_share_and_time_left(board, clock, caplog):
    with under_way("train", board):
        clock.now += 10
        for step in progress.progress(range(100), "training", "step", board=board):
            board.tell()
            clock.now += 2
            assert step == len(lines(caplog)) * 15 - 5 + (step + 5) % 15
    # the stage began at 0 s and the steps at 10 s; a line is due at 30, 60, ... s; each step takes 2 s
    assert lines(caplog) == [
        f"train: training {done}% ({done} of 100 steps), {duration(2 * (100 - done))} left; {duration(10 + 2 * done)} so far"
        for done in range(10, 100, 15)
    ]


def test_no_line_before_its_time_and_none_when_nothing_is_under_way(board, clock, caplog):
    board.tell()
    with under_way("label", board):
        clock.now += INTERVAL - 0.1
        board.tell()
    clock.now += 100
    board.tell()
    assert not lines(caplog)


def test_short_stages_one_after_another_share_the_30_seconds(board, clock, caplog):
    with under_way("run", board):
        for number in range(10):
            with under_way(f"stage {number}", board):
                clock.now += 8
                board.tell()
    assert lines(caplog) == ["run: stage 3; 32 s so far", "run: stage 7; 64 s so far"]


def test_work_that_goes_on_from_a_checkpoint_is_not_taken_for_faster(board, clock, caplog):
    with Progress(1000, "training", "step", initial=900, board=board) as task:
        clock.now += 40
        task.update(10)  # 4 s each
        task.show("loss 0.1")
        board.tell()
    assert lines(caplog) == ["training 91% (910 of 1000 steps), 6 min left, loss 0.1; 40 s so far"]


def test_work_of_unknown_size_and_per_cent(board, clock, caplog):
    with Progress(None, "matching", "pair", board=board) as task:
        task.update(7)
        clock.now += 30
        board.tell()
    with Progress(100, "making", "%", board=board) as task:
        task.advance_to(50)
        clock.now += 30
        board.tell()
    assert lines(caplog) == ["matching 7 pairs; 30 s so far", "making 50%, 30 s left; 30 s so far"]


def test_the_thread_tells_in_a_call_without_steps(board, clock, caplog):
    clock.now = 0.0

    class Ended:
        """Never waits, and ends after the third look."""

        waited = 0

        def wait(self, seconds):
            assert seconds == pytest.approx(INTERVAL)
            self.waited += 1
            clock.now += seconds
            return self.waited > 3

    with under_way("mapping", board):
        board._watch(Ended())
    assert lines(caplog) == [f"mapping; {text} so far" for text in ("30 s", "60 s", "90 s")]


def test_steps_from_several_threads_are_all_counted(board):
    import threading

    with Progress(8000, "voting", "view", board=board) as task:
        threads = [threading.Thread(target=lambda: [task.update() for _ in range(1000)]) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert task.done == 8000


def test_polled_work_is_done_at_its_end_unless_it_fails(board, monkeypatch):
    monkeypatch.setattr(progress, "POLL", 0.0001)
    task = Progress(5, "features", "photo", board=board)
    with polled(task, lambda: None):
        pass
    assert task.done == 5
    task = Progress(5, "features", "photo", board=board)
    with pytest.raises(KeyError), polled(task, lambda: None):
        raise KeyError
    assert task.done == 0 and not board._tasks


def test_an_interrupted_loop_is_not_under_way_any_more(board):
    for _ in progress.progress(range(3), "fusing", "view", board=board):
        break
    with pytest.raises(ValueError):
        for _ in progress.progress(range(3), "fusing", "view", board=board):
            raise ValueError
    import gc

    gc.collect()
    assert not board._tasks


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        (0, "0 s"),
        (99.4, "99 s"),
        (99.5, "2 min"),
        (3600, "60 min"),
        (5999, "1 h 40 min"),
        (86400, "24 h 0 min"),
    ],
)
def test_durations(seconds, told):
    assert duration(seconds) == told


class Terminal(io.StringIO):
    def isatty(self):
        return True


def told_to(stream, monkeypatch, log=None, **options):
    """What a stage writes that works for 100 s, with a message in between."""
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # without pytest's
    clock = Clock()
    board = Board(clock)
    messages.start_logging(log=log, **options)
    board.bars = progress.BOARD.bars
    with under_way("label", board):
        for _ in progress.progress(range(4), "voting \x1b[31m", "view", board=board):
            clock.now += 25
            board.tell()
            logging.getLogger("sc3d.x").info("a message\x07")
            logging.getLogger("sc3d.x").debug("for the search of faults")
    return stream.getvalue()


def test_a_pipe_gets_lines_without_control_characters(logs, monkeypatch):
    text = told_to(io.StringIO(), monkeypatch)
    assert not CONTROL.search(text) and text.endswith("\n")
    assert text.count("so far\n") == 2 and text.count("a message?\n") == 4 and "faults" not in text


def test_a_terminal_gets_a_bar_instead_and_the_file_all_lines(logs, monkeypatch, tmp_path):
    log = tmp_path / "file.log"
    log.write_text("before\n")
    text = told_to(Terminal(), monkeypatch, log)
    assert "4/4" in text and "so far" not in text and text.count("a message?") == 4
    written = log.read_text(encoding="utf-8")
    assert (
        written.startswith("before\n") and written.count("so far\n") == 2 and written.count("message?") == 4
    )
    assert not CONTROL.search(written)
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d \S", line) for line in written.splitlines()[1:])


def test_quiet_and_verbose(logs, monkeypatch, tmp_path):
    log = tmp_path / "file.log"
    assert told_to(Terminal(), monkeypatch, log, quiet=True) == ""
    assert "a message" in log.read_text(encoding="utf-8")
    assert "faults" in told_to(io.StringIO(), monkeypatch, verbose=True)


def test_a_log_that_cannot_be_written_is_refused(logs, tmp_path):
    with pytest.raises(InputError, match="name a file in a folder that exists"):
        messages.start_logging(log=tmp_path / "nowhere" / "file.log")


def test_bars_are_made_in_one_place_only():
    root = Path(sc3d.__file__).parent
    users = [
        file.relative_to(root).as_posix()
        for file in [*root.rglob("*.py"), *(root.parent / "tools").rglob("*.py")]
        if re.search(r"^\s*(from|import) tqdm", file.read_text("utf-8"), re.M)
    ]
    assert users == ["io/progress.py"]


def test_messages_are_not_lost_where_a_library_is_kept_quiet(logs, monkeypatch, tmp_path):
    """As the pictures of the report are: file descriptor 2 leads elsewhere meanwhile."""
    heard, kept = tmp_path / "heard", tmp_path / "kept"
    saved = os.dup(2)
    with heard.open("w") as first, kept.open("w") as second:
        try:
            os.dup2(first.fileno(), 2)
            monkeypatch.setattr(sys, "stderr", open(2, "w", closefd=False))
            monkeypatch.setattr(logging.getLogger(), "handlers", [])
            messages.start_logging()
            outside = os.dup(2)
            os.dup2(second.fileno(), 2)
            with messages.messages_to(outside):
                logging.getLogger("sc3d.x").info("during")
                os.write(2, b"chatter")
            os.dup2(outside, 2)
            os.close(outside)
            logging.getLogger("sc3d.x").info("after")
        finally:
            os.dup2(saved, 2)
            os.close(saved)
    assert heard.read_text() == "during\nafter\n" and kept.read_text() == "chatter"
