"""Training: it learns, stops and goes on as if it had not, and loses nothing that it kept."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from safetensors import safe_open
from toy_training_task import TOGETHER, ToyTask, fresh_network

from semviz_core.common.errors import SemvizError
from semviz_core.research.training.batch import Progress
from semviz_core.research.training.checkpoint import (
    WINDOW_STEPS,
    Checkpoint,
    has_bf16,
    read_history,
)
from semviz_core.research.training.trainer import (
    CHECKPOINT,
    HISTORY,
    LOCK,
    Trainer,
    TrainerEvent,
    TrainingOptions,
)

TOY = Path(__file__).parents[1] / "toy_training_task.py"
OPTIONS = TrainingOptions(samples=1200, batch=4, workers=0, held_out=8)


def trained(folder: Path, task: ToyTask | None = None, **options: object) -> Trainer:
    training = Trainer(task or ToyTask(), folder, replace(OPTIONS, **options))
    training.run()
    return training


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    return Checkpoint.load(folder / CHECKPOINT).tensors


def assert_same(path: Path, other: Path) -> None:
    """The same weights and moments to the last bit, and the same history."""
    left, right = tensors(path), tensors(other)
    assert left.keys() == right.keys()
    assert all(torch.equal(left[name], right[name]) for name in left)
    assert read_history(path / HISTORY) == read_history(other / HISTORY)


def stopped_after(folder: Path, samples: int, **options: object) -> None:
    """A training that is asked to stop at a sample, as ctrl-C does."""
    training = Trainer(ToyTask(), folder, replace(OPTIONS, **options))

    def tell(moment: TrainerEvent) -> None:
        if moment.samples == samples:
            os.kill(os.getpid(), signal.SIGINT)

    assert training.run(tell) == "interrupted"
    assert training.progress.samples == samples


def test_it_learns(tmp_path: Path) -> None:
    training = trained(tmp_path)
    first, *_, last = [
        line["held_out"]["error"] for line in read_history(tmp_path / HISTORY) if "held_out" in line
    ]
    assert last < 0.5 * first
    assert training.progress.held_out["items"] == 8


@pytest.mark.parametrize("samples", [[4], [400, 404, 1196]])
def test_going_on_is_the_same_as_never_stopping(tmp_path: Path, samples: list[int]) -> None:
    trained(tmp_path / "whole")
    for number in samples:
        stopped_after(tmp_path / "parts", number)
    trained(tmp_path / "parts", samples=None)
    assert_same(tmp_path / "whole", tmp_path / "parts")


def test_the_number_of_workers_changes_nothing(tmp_path: Path) -> None:
    for workers in (0, 2):
        trained(tmp_path / str(workers), samples=100, workers=workers)
    assert_same(tmp_path / "0", tmp_path / "2")


def test_another_seed_sees_other_items(tmp_path: Path) -> None:
    for seed in (0, 1):
        trained(tmp_path / str(seed), samples=40, seed=seed)
    first, other = tensors(tmp_path / "0"), tensors(tmp_path / "1")
    assert not torch.equal(first["network.0.weight"], other["network.0.weight"])


def test_killed_at_any_moment_it_goes_on_from_a_whole_checkpoint(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    folder, seen = tmp_path / "killed", [0]
    for _ in range(6):
        process = born(folder, save_every_s=0.02)
        time.sleep(rng.uniform(0.05, 0.3))
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        if (folder / CHECKPOINT).is_file():
            seen.append(Checkpoint.load(folder / CHECKPOINT).progress.samples)
    assert seen == sorted(seen)
    assert 0 < seen[-1] < 1200
    trained(folder)
    trained(tmp_path / "whole")
    assert_same(tmp_path / "whole", folder)


def test_sigterm_saves(tmp_path: Path) -> None:
    process = born(tmp_path, save_every_s=1e6, workers=1)
    time.sleep(0.3)
    assert not (tmp_path / CHECKPOINT).is_file()
    process.terminate()
    process.join()
    assert process.exitcode == 0
    assert 0 < Checkpoint.load(tmp_path / CHECKPOINT).progress.samples < 1200


def test_only_one_process_trains_in_a_folder(tmp_path: Path) -> None:
    process = born(tmp_path)
    with pytest.raises(SemvizError, match="another process is training there"):
        trained(tmp_path)
    process.kill()
    process.join()
    trained(tmp_path)


def born(folder: Path, **options: object) -> ForkProcess:
    """A process that has begun to train, too slowly to come to the end."""
    fork = get_context("fork")
    begun = fork.Event()

    def train() -> None:
        training = Trainer(ToyTask(delay_s=0.01), folder, replace(OPTIONS, **options))
        training.run(lambda moment: begun.set())

    process = fork.Process(target=train)
    process.start()
    assert begun.wait(30.0)
    return process


def test_two_processes_learn_what_one_does(tmp_path: Path) -> None:
    """Of each batch of 4, two items each: the mean of their gradients is that of all four."""
    Trainer(ToyTask(network=fresh_network(dropout=0.0)), tmp_path / "one", TOGETHER).run()
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
         TOY, tmp_path / "two"],
        capture_output=True, text=True, timeout=120,
        env={**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("finished") == 2
    first, second = tensors(tmp_path / "one"), tensors(tmp_path / "two")
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=1e-4, atol=1e-5)


def test_time_can_be_boxed(tmp_path: Path) -> None:
    start_s = time.perf_counter()
    options = replace(OPTIONS, stop_after_s=0.05, save_every_s=0.01)
    training = Trainer(ToyTask(delay_s=0.002), tmp_path, options)
    assert training.run() == "time is over"
    assert 0 < training.progress.samples < 1200
    spent_s = sum(training.progress.seconds.values())
    again = Trainer(ToyTask(), tmp_path, replace(OPTIONS, samples=None, save_every_s=0.01))
    again.run()
    whole_s = sum(again.progress.seconds.values())  # of both sessions
    assert 0.05 <= spent_s < whole_s <= time.perf_counter() - start_s


def test_a_plan_can_be_changed_but_not_undone(tmp_path: Path) -> None:
    trained(tmp_path, samples=41)
    training = trained(tmp_path, samples=80)
    assert training.progress.plans == [(0, 44), (44, 80)]
    with pytest.raises(SemvizError, match="has seen 80 samples already, more than 40"):
        trained(tmp_path, samples=40)


def test_a_step_that_is_not_finite_is_left_out(tmp_path: Path) -> None:
    training = trained(tmp_path, ToyTask(infinite=range(100, 120)))
    assert training.progress.skipped == 5
    assert all(value.isfinite().all() for value in tensors(tmp_path).values())
    with pytest.raises(SemvizError, match="50 steps in a row"):
        trained(tmp_path / "more", ToyTask(infinite=range(2000)))


REFUSED = {
    "another task": ({"name": "other"}, {}, "task was toy, is other"),
    "other classes": (
        {"options": {"width": 16, "classes": ["sign"]}},
        {},
        r"options classes was \['pole'\]",
    ),
    "another network": ({"network": torch.nn.Linear(4, 1)}, {}, "weights of another network"),
    "another batch": ({}, {"batch": 8}, "batch was 4, is 8"),
    "another seed": ({}, {"seed": 1}, "seed was 0, is 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_another_training_is_never_overwritten(tmp_path: Path, case: str) -> None:
    task, options, line = REFUSED[case]
    trained(tmp_path, samples=40)
    before = (tmp_path / CHECKPOINT).read_bytes()
    with pytest.raises(SemvizError, match=line):
        trained(tmp_path, ToyTask(**task), **options)
    assert (tmp_path / CHECKPOINT).read_bytes() == before


@pytest.mark.parametrize("fault", ["version", "cut", "other file"])
def test_what_is_no_checkpoint_is_named(tmp_path: Path, fault: str) -> None:
    trained(tmp_path, samples=40)
    path = tmp_path / CHECKPOINT
    whole = path.read_bytes()
    changed = {
        "version": whole.replace(rb"\"format\": 1", rb"\"format\": 7"),
        "cut": whole[:-10],
        "other file": b"no checkpoint",
    }[fault]
    assert changed != whole
    path.write_bytes(changed)
    with pytest.raises(SemvizError, match=r"format 7" if fault == "version" else "damaged"):
        trained(tmp_path)
    assert path.read_bytes() == changed


def header_changed(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Rewrite a checkpoint whose header was changed, as somebody would who means harm."""
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["semviz training"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header.pop("crc32")
    change(header)
    metadata = {"semviz training": json.dumps(header)}
    path.write_bytes(safetensors.torch.save(tensors, metadata=metadata))


HOSTILE: dict[str, tuple[str, str, Any]] = {
    "a name that leaves the folder": ("identity", "task", "../../labels"),
    "a name that is a list": ("identity", "task", ["toy"]),
    "a batch of none": ("identity", "batch", 0),
    "a seed as text": ("identity", "seed", "0"),
    "options that are a text": ("identity", "options", "width"),
    "samples as text": ("course", "samples", "12"),
    "less than no samples": ("course", "samples", -4),
    "infinite time": ("course", "seconds", {"a machine": float("inf")}),
    "a plan of one number": ("course", "plans", [[0]]),
    "a sum that is a text": ("course", "window", {"loss": ["x", 1]}),
    "a name that is no text": ("course", "seconds", {"\ud800": 1.0}),
    "an unknown value": ("course", "more", 1),
    "an enormous number": ("course", "skipped", 10**4000),
    "a deep list": ("identity", "options", json.loads("[" * 900 + "]" * 900)),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_checkpoint_is_one_line(tmp_path: Path, case: str) -> None:
    part, name, value = HOSTILE[case]
    trained(tmp_path, samples=40)
    header_changed(tmp_path / CHECKPOINT, lambda header: header[part].update({name: value}))
    with pytest.raises(SemvizError, match="not a checkpoint of semviz, or damaged"):
        Checkpoint.load(tmp_path / CHECKPOINT)


def test_a_header_without_checksum_is_of_an_earlier_version(tmp_path: Path) -> None:
    trained(tmp_path, samples=40)
    header_changed(tmp_path / CHECKPOINT, lambda header: None)
    assert Checkpoint.load(tmp_path / CHECKPOINT).progress.samples == 40


def test_moments_of_another_shape_are_one_line(tmp_path: Path) -> None:
    trained(tmp_path, samples=40)
    stored = Checkpoint.load(tmp_path / CHECKPOINT)
    for name in ("adam.step.0.bias", "adam.exp_avg.0.weight"):
        changed = stored.tensors | {name: torch.zeros(3, 5)}
        Checkpoint(stored.identity, stored.progress, changed).save(tmp_path / CHECKPOINT)
        with pytest.raises(SemvizError, match="weights of another network"):
            trained(tmp_path, samples=80)


def test_a_flipped_bit_of_a_checkpoint_is_found(tmp_path: Path) -> None:
    trained(tmp_path, samples=40)
    path, rng = tmp_path / CHECKPOINT, np.random.default_rng(3)
    whole, stored = path.read_bytes(), Checkpoint.load(path)
    found = 0
    for _ in range(200):
        changed = bytearray(whole)
        changed[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        try:
            read = Checkpoint.load(path)
        except SemvizError:
            found += 1
            continue
        assert (read.identity, read.progress) == (stored.identity, stored.progress)
        assert all(torch.equal(read.tensors[name], stored.tensors[name]) for name in read.tensors)
        assert read.tensors.keys() == stored.tensors.keys()
    assert found > 150


LOSSES = {
    "a number that is a text": b'{"samples": "x"}',
    "100,000 lists": b"[" * 100_000,
    "losses that are a list": b'{"samples": 4, "losses": [1]}',
    "an infinite loss": b'{"samples": 4, "losses": {"loss": Infinity}}',
    "no text": b"\xff\xfe",
}


@pytest.mark.parametrize("case", LOSSES)
def test_hostile_losses_are_one_line(tmp_path: Path, case: str) -> None:
    (tmp_path / HISTORY).write_bytes(LOSSES[case] + b"\n")
    with pytest.raises(SemvizError, match="not the losses of a training; move it away"):
        trained(tmp_path, samples=40)


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize(
    ("task", "line"),
    [
        (ToyTask(nan_from=40), "items from 40 on: a number is NaN"),
        (ToyTask(broken_from=40), "no frame has 4 labels"),
    ],
)
def test_bad_data_is_one_line(tmp_path: Path, task: ToyTask, line: str, workers: int) -> None:
    with pytest.raises(SemvizError, match=line):
        trained(tmp_path, task, workers=workers)


@pytest.mark.parametrize("step_s", [0.0, 0.1])
def test_a_worker_that_dies_is_one_line(tmp_path: Path, step_s: float) -> None:
    """While its batch is waited for, and in the middle of a step."""

    class Deadly(ToyTask):
        def learning_rate(self, progress: Progress) -> float:
            time.sleep(step_s if progress.samples > 180 else 0.0)
            return super().learning_rate(progress)

        def make(self, number: int) -> np.ndarray:
            if number == 200:
                os.kill(os.getpid(), signal.SIGKILL)
            return super().make(number)

    with pytest.raises(SemvizError, match="a worker process ended"):
        trained(tmp_path, Deadly(), workers=1)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SemvizError, match="cannot be written"):
        trained(tmp_path / "file" / "folder")


def test_a_full_disk_leaves_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained(tmp_path, samples=40)
    before = (tmp_path / CHECKPOINT).read_bytes()

    def full(self: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SemvizError, match=r"checkpoint.safetensors: cannot be written \(No space"):
        trained(tmp_path, samples=80)
    assert (tmp_path / CHECKPOINT).read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {CHECKPOINT, HISTORY, LOCK}


def test_the_history_is_of_means(tmp_path: Path) -> None:
    losses: list[float] = []
    Trainer(ToyTask(), tmp_path, OPTIONS).run(lambda moment: losses.append(moment.loss))
    lines = [line for line in read_history(tmp_path / HISTORY) if "losses" in line]
    assert [line["samples"] for line in lines] == [4 * WINDOW_STEPS, 1200]
    for line, part in zip(lines, (losses[:WINDOW_STEPS], losses[WINDOW_STEPS:]), strict=True):
        assert line["losses"]["loss"] == pytest.approx(np.mean(part), rel=1e-5)


def test_a_torn_line_of_the_history_is_dropped(tmp_path: Path) -> None:
    trained(tmp_path, samples=400)
    before = read_history(tmp_path / HISTORY)
    with (tmp_path / HISTORY).open("a") as file:
        file.write(json.dumps({"samples": 800, "held_out": {}}) + '\n{"samples"')
    trained(tmp_path, samples=None)
    assert read_history(tmp_path / HISTORY) == before


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"samples": 0}, "--samples 0: give 1 to"),
        ({"batch": 0}, "--batch 0"),
        ({"seed": 100}, "--seed 100: give 0 to 99"),
        ({"workers": -1}, "--workers -1"),
    ],
)
def test_options_that_make_no_sense(tmp_path: Path, options: dict[str, object], line: str) -> None:
    with pytest.raises(SemvizError, match=line):
        trained(tmp_path, **options)
    assert not list(tmp_path.iterdir())


def test_few_bits_are_refused_where_they_are_slow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("semviz_core.research.training.checkpoint.has_bf16", lambda device: False)
    with pytest.raises(SemvizError, match="--precision bf16: is for a GPU or a processor with AMX"):
        trained(tmp_path, precision="bf16")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not has_bf16(torch.device("cpu")), reason="this processor has no bfloat16")
def test_it_learns_with_few_bits_too(tmp_path: Path) -> None:
    exact, rough = trained(tmp_path / "exact"), trained(tmp_path / "rough", precision="bf16")
    assert rough.progress.held_out["error"] < 2.0 * exact.progress.held_out["error"]
