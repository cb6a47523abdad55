"""Files of weights: what comes back, and what is refused with one line."""

import os
from pathlib import Path

import pytest
import torch
from torch import nn

from semviz_core.base import weights
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, ClassSet
from semviz_core.base.weights import NetworkWeights, load_trained, read_weights
from semviz_core.common.errors import SemvizError

NAMES = [class_.name for class_ in DEFAULT_CLASSES]


def saved(path: Path, network: nn.Module, task: str = "paper") -> Path:
    tensors = {name: value.numpy() for name, value in network.state_dict().items()}
    NetworkWeights(task, {"classes": NAMES}, tensors).save(path)
    return path


def test_weights_come_back_as_half_precision_keeps_them(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network, other = nn.Linear(3, 2), nn.Linear(3, 2)
    path = saved(tmp_path / "paper.safetensors", network)
    read = read_weights(path)
    read.check("paper", DEFAULT_CLASSES, path)
    read.load_into(other, path)
    assert read.options == {"classes": NAMES}
    assert torch.equal(other.weight, network.weight.half().float())


def test_a_missing_or_foreign_or_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "paper.safetensors"
    with pytest.raises(SemvizError, match="no such weights"):
        read_weights(path)
    path.write_bytes(b"nothing")
    with pytest.raises(SemvizError, match="not weights of semviz, or damaged"):
        read_weights(path)
    saved(path, nn.Linear(3, 2))
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(SemvizError, match="damaged"):
        read_weights(path)


def test_weights_of_another_format_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path / "paper.safetensors", nn.Linear(3, 2))
    monkeypatch.setattr(weights, "FORMAT", 2)
    with pytest.raises(SemvizError, match="of format 1, this semviz reads 2"):
        read_weights(path)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    network = nn.Linear(3, 2)
    network.bias.data[0] = torch.nan
    with pytest.raises(SemvizError, match="not finite"):
        read_weights(saved(tmp_path / "paper.safetensors", network))


def test_weights_for_something_else_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "x.safetensors", nn.Linear(3, 2))
    read = read_weights(path)
    with pytest.raises(SemvizError, match="weights of paper; give those of bpnpnet"):
        read.check("bpnpnet", DEFAULT_CLASSES, path)
    with pytest.raises(SemvizError, match=r"trained for the classes pole, .*, not for pole"):
        read.check("paper", ClassSet((DEFAULT_CLASSES[POLE],)), path)
    with pytest.raises(SemvizError, match="weights of another version of paper"):
        read.load_into(nn.Linear(4, 2), path)


def bias_of(read: NetworkWeights, classes: ClassSet, path: Path) -> list[float]:
    return list(read.tensors["bias"])


def test_what_is_made_of_weights_is_made_once_for_each_state_of_the_file(tmp_path: Path) -> None:
    path = saved(tmp_path / "paper.safetensors", nn.Linear(3, 2))
    made = load_trained("paper", path, DEFAULT_CLASSES, bias_of)
    assert load_trained("paper", path, DEFAULT_CLASSES, bias_of) is made
    network = nn.Linear(3, 2)
    network.bias.data = torch.tensor([0.5, -2.0])
    saved(path, network)
    os.utime(path, ns=(0, 0))  # a clock may be too coarse to tell the two files apart
    assert load_trained("paper", path, DEFAULT_CLASSES, bias_of) == [0.5, -2.0]
    with pytest.raises(SemvizError, match="weights of paper; give those of bpnpnet"):
        load_trained("bpnpnet", path, DEFAULT_CLASSES, bias_of)


def test_weights_are_those_of_their_card(tmp_path: Path) -> None:
    """A flipped bit may leave a finite number; the shipped weights all have their card."""
    path = tmp_path / "verifier.safetensors"
    shipped = weights.shipped_weights("verifier")
    content, card = shipped.read_bytes(), shipped.with_suffix(".json").read_bytes()
    path.write_bytes(content[:-100] + bytes([content[-100] ^ 1]) + content[-99:])
    read_weights(path)
    path.with_suffix(".json").write_bytes(card)
    with pytest.raises(SemvizError, match=r"not the weights that their card verifier\.json"):
        read_weights(path)
    for shipped in weights.SHIPPED.glob("*.safetensors"):
        assert shipped.with_suffix(".json").is_file()
        read_weights(shipped)
    path.write_bytes(content)
    path.with_suffix(".json").write_bytes(card[: len(card) // 2])
    with pytest.raises(SemvizError, match="one of the two is damaged"):
        read_weights(path)
