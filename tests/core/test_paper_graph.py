"""The paper's graph network: what must not change its features, and that it is the paper's."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from semviz_core.research.paper.matcher_torch import (
    GraphNetwork,
    RealRows,
    context_norm,
    edge_mean,
    nearest,
)

INPUTS, NEIGHBOURS = 10, 4
torch.set_num_threads(1)  # samples are small: more threads would wait for each other


@pytest.fixture(scope="module")
def network() -> GraphNetwork:
    torch.manual_seed(1)
    return GraphNetwork(INPUTS, NEIGHBOURS).double()


def elements(n: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(2, n, INPUTS, generator=generator, dtype=torch.float64)


def all_real(n: int) -> Tensor:
    return torch.ones(2, n, dtype=torch.bool)


@pytest.mark.parametrize("n", [1, 2, 4, 5, 6, 30])
def test_padding_changes_nothing(network: GraphNetwork, n: int) -> None:
    alone = network(elements(n), all_real(n))
    assert alone.isfinite().all()
    padded = torch.cat([elements(n), elements(7, seed=1) * 5.0], dim=1)
    real = torch.cat([all_real(n), ~all_real(7)], dim=1)
    torch.testing.assert_close(network(padded, real)[:, :n], alone)


def test_the_order_of_elements_only_orders_features(network: GraphNetwork) -> None:
    order = torch.randperm(20, generator=torch.Generator().manual_seed(2))
    features = network(elements(20), all_real(20))
    torch.testing.assert_close(network(elements(20)[:, order], all_real(20)), features[:, order])


def test_each_element_hears_of_all_others(network: GraphNetwork) -> None:
    changed = elements(30)
    changed[:, 0] += 1.0
    moved = (network(changed, all_real(30)) - network(elements(30), all_real(30))).abs()
    assert (moved.amax(dim=2) > 1e-6).all()


def test_a_layer_is_the_average_of_a_perceptron_over_anchors_and_edges(
    network: GraphNetwork,
) -> None:
    n = 12
    layer = network.layers[0]
    features = network.inlet(elements(n))
    rows = RealRows.of(all_real(n), torch.float64)
    normal = context_norm(features, rows.share)
    distance = torch.cdist(normal, normal) + torch.diag(torch.full((n,), torch.inf))
    near = distance.topk(NEIGHBOURS, largest=False).indices
    anchor_weight, neighbour_weight = layer.before.weight.chunk(2)
    bias = layer.before.bias.chunk(2)
    expected = features.clone()
    for item in range(2):
        for i in range(n):
            edges = normal[item, near[item, i]] - normal[item, i]
            anchor = normal[item, i].expand_as(edges)
            both = torch.cat([anchor, edges], dim=1)
            weight = torch.cat([anchor_weight + neighbour_weight, neighbour_weight], dim=1)
            hidden = functional.relu(functional.linear(both, weight, bias[0] + bias[1]))
            expected[item, i] += layer.after(hidden).mean(dim=0)
    torch.testing.assert_close(layer(features, rows), expected)


def test_the_mean_over_edges_and_its_gradient_are_those_of_edges_one_by_one() -> None:
    ends = torch.randn(9, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    near = torch.randint(0, 9, (9, 4), generator=torch.Generator().manual_seed(4))
    ends.requires_grad_()
    anchor, neighbour = ends.chunk(2, dim=1)
    one_by_one = functional.relu(anchor[:, None] + neighbour[near]).mean(dim=1)
    torch.testing.assert_close(edge_mean(ends, near), one_by_one)
    assert torch.autograd.gradcheck(lambda given: edge_mean(given, near), (ends,))


def test_numbers_of_16_bits_are_summed_as_32() -> None:
    ends = torch.randn(9, 12, generator=torch.Generator().manual_seed(5)).bfloat16()
    near = torch.zeros(9, 4, dtype=torch.int64)
    torch.testing.assert_close(edge_mean(ends, near), edge_mean(ends.float(), near))


def test_the_nearest_leave_out_the_element_itself_unless_there_are_too_few() -> None:
    line = torch.tensor([[[0.0], [1.0], [3.0], [7.0]]])
    real = torch.ones(1, 4, dtype=torch.bool)
    assert near(line, real, 2) == [[1, 2], [0, 2], [1, 0], [2, 1]]
    real[0, 3] = False
    assert near(line, real, 3) == [[1, 2, 0], [0, 2, 1], [1, 0, 2]]
    assert near(line[:, :1], real[:, :1], 2) == [[0, 0]]


def test_the_nearest_are_of_the_same_frame() -> None:
    line = torch.tensor([[[0.0], [1.0], [3.0]], [[9.0], [0.0], [2.0]]])
    real = torch.tensor([[True, True, True], [False, True, True]])
    assert near(line, real, 1) == [[1], [0], [1], [4], [3]]


def near(features: Tensor, real: Tensor, neighbours: int) -> list[list[int]]:
    found: list[list[int]] = nearest(
        features, RealRows.of(real, torch.float32), neighbours
    ).tolist()
    return found
