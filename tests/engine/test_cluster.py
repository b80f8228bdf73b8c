"""Work shared out to processes: the same results, whoever dies."""

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import dask
import pytest

from skyquilt.engine import cluster as module
from skyquilt.engine.cluster import cluster
from skyquilt.engine.workers import workers_for
from skyquilt.errors import PhotoFailedError, SkyquiltError, UsageError
from skyquilt.settings import RunningSettings


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    with cluster("local:2", tmp_path_factory.mktemp("state"), [Path(__file__)]) as found:
        yield found


def dies_once(at: Path):
    def work(number: int) -> int:
        if number == 3 and not at.exists():
            at.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return number * number

    return work


@pytest.mark.slow
def test_results_come_in_order_from_other_processes(two):
    def work(number: int) -> tuple[int, int]:
        time.sleep(0.01 * (number % 3))
        return number, os.getpid()

    found = list(two.each(work, range(40)))
    assert [n for n, _ in found] == list(range(40))
    assert len({p for _, p in found}) == 2 and os.getpid() not in {p for _, p in found}
    assert list(two.each(work, [])) == []


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced_and_told(two, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "POLL_S", 0.1)
    two.news()
    assert list(two.each(dies_once(tmp_path / "died"), range(12))) == [n * n for n in range(12)]
    assert (tmp_path / "died").exists()


@pytest.mark.slow
def test_a_worker_that_dask_has_given_up_is_started_again(tmp_path, monkeypatch):
    """As Dask does where the process has not come back some seconds after it died."""
    monkeypatch.setattr(module, "POLL_S", 0.1)
    monkeypatch.setattr(module, "PATIENCE_S", 5.0)
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "0s"}),
        cluster("local:1", tmp_path, []) as found,
    ):
        assert list(found.each(dies_once(tmp_path / "died"), range(5))) == [0, 1, 4, 9, 16]


@pytest.mark.slow
def test_a_task_that_ends_every_worker_ends_the_run(two):
    def deadly(_: int) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(SkyquiltError, match="6 workers died of the same task"):
        list(two.each(deadly, [1]))
    assert list(two.each(str, [1, 2])) == ["1", "2"]  # others took their place


@pytest.mark.slow
@pytest.mark.parametrize("error", [PhotoFailedError("a.jpg", "is torn"), TimeoutError("slow")])
def test_an_error_of_the_work_arrives_as_it_is(two, error):
    def work(number: int) -> int:
        if number == 2:
            raise error
        return number

    got = two.each(work, range(5))
    assert [next(got), next(got)] == [0, 1]
    with pytest.raises(type(error), match=str(error)):
        next(got)


@pytest.mark.slow
def test_relative_paths_are_those_of_the_run(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here.txt").write_text("seen")
    here = Path("here.txt")
    assert list(two.each(lambda _: here.read_text(), [0])) == ["seen"]


@pytest.mark.slow
def test_a_step_is_written_once_and_nothing_is_left_of_it(two):
    def work(number: int) -> int:
        return number

    folder = two._folder
    running = two.each(work, range(100))
    next(running)
    step = list(folder.iterdir())
    running.close()
    assert list(two.each(work, range(3))) == [0, 1, 2]
    assert list(folder.iterdir()) == step and len(step) == 1
    list(two.each(str, [1]))
    assert len(list(folder.iterdir())) == 1 and list(folder.iterdir()) != step
    two.close()
    assert not folder.exists()


@pytest.mark.slow
def test_a_scheduler_that_goes_away_ends_the_run_with_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "POLL_S", 0.2)
    monkeypatch.setattr(module, "PATIENCE_S", 2.0)
    file = tmp_path / "scheduler.json"
    words = ["--scheduler-file", str(file), "--no-dashboard", "--host", "127.0.0.1", "--port", "0"]
    boss = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_scheduler", *words], stderr=subprocess.DEVNULL
    )
    hand = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_worker", *words[:3], "--no-nanny"],
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 20
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)

        def work(number: int) -> int:
            time.sleep(0.2)
            return number

        with cluster(str(file), tmp_path, []) as found:
            results = found.each(work, range(500))
            assert next(results) == 0
            boss.kill()
            with pytest.raises(SkyquiltError, match="gone; start them"):
                list(results)
    finally:
        for process in (boss, hand):
            process.kill()
            process.wait()


def test_no_scheduler_there(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "ANSWER_S", 0.5)
    with (
        pytest.raises(UsageError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"),
        cluster("tcp://127.0.0.1:9", tmp_path, []),
    ):
        pass


@pytest.mark.parametrize("what", ["{}", "[1, 2]", "", '{"address": 5}', '{"address": "x"}', "\\0"])
def test_a_scheduler_file_that_is_none(tmp_path, what):
    file = tmp_path / "scheduler.json"
    file.write_text(what)
    with (
        pytest.raises(UsageError, match="is no scheduler file: it holds no address"),
        workers_for(RunningSettings(scheduler=str(file)), tmp_path, []),
    ):
        pass


@pytest.mark.parametrize(
    "asked", ["local:0", "local:", "local:x", "local:٣", "local:9999", "no.json"]
)
def test_schedulers_that_are_none(asked):
    with pytest.raises(UsageError, match="--scheduler"):
        RunningSettings(scheduler=asked)


def test_workers_that_cannot_take_part(tmp_path):
    def told(**about):
        file = tmp_path / "step"
        file.write_bytes(pickle.dumps({"sees": [], "version": module._version()} | about))
        return module._unfit(str(file))

    assert told() == ""
    assert "does not see /nowhere/a.jpg; the photos must lie" in told(sees=["/nowhere/a.jpg"])
    assert "instead of skyquilt 0.0, Python 3" in told(version=["skyquilt 0.0", "Python 3"])
    assert "the run's folder must lie" in module._unfit(str(tmp_path / "other"))
