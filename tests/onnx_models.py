"""ONNX models with an answer that is known, and the TOML that says how to read them."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tomli_w
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

Array = NDArray[Any]
COLORS = {"pole": (250, 220, 30), "sign": (200, 20, 40)}
BLOCK = 48
LABELS = ["road", "pole", "traffic sign"]


def answering(path: Path, outputs: dict[str, Array], size: tuple[int, int]) -> Path:
    """A model that gives the same outputs for every image of ``size`` (width, height)."""
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(output))
        for name, output in outputs.items()
    ]
    told = [
        helper.make_tensor_value_info(
            name, helper.np_dtype_to_tensor_dtype(output.dtype), list(output.shape)
        )
        for name, output in outputs.items()
    ]
    return _save(path, nodes, [_image(*size)], told, [])


def painted(path: Path, size: tuple[int, int], stride: int, label_map: bool = False) -> Path:
    """A segmenter that knows ``COLORS``: 20 times minus the squared distance to each.

    Logits, or labels, are means over ``stride`` pixels.
    """
    colors = np.array([[90, 90, 90], *COLORS.values()], np.float32) / 255.0
    weight = 40.0 * colors.reshape(3, 3, 1, 1)
    bias = -20.0 * (colors**2).sum(axis=1)
    constants = [numpy_helper.from_array(value, n) for value, n in ((weight, "w"), (bias, "b"))]
    nodes = [
        helper.make_node("Conv", ["image", "w", "b"], ["fine"]),
        helper.make_node(
            "AveragePool",
            ["fine"],
            ["logits"],
            kernel_shape=[stride, stride],
            strides=[stride, stride],
        ),
        helper.make_node("ArgMax", ["logits"], ["labels"], axis=1, keepdims=0),
    ]
    width, height = size[0] // stride, size[1] // stride
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, height, width])
    labels = helper.make_tensor_value_info("labels", TensorProto.INT64, [1, height, width])
    return _save(path, nodes, [_image(*size)], [labels if label_map else logits], constants)


def knowing(path: Path, images: Array, label_maps: Array) -> Path:
    """A segmenter that knows the answers for these images (n, height, width, 3) by heart.

    An image is known by its means over blocks of ``BLOCK`` pixels. Label maps (n, h, w) are bytes.
    """
    n, height, width = images.shape[:3]
    blocks = images.reshape(n, height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).mean((2, 4))
    known = np.moveaxis(blocks, -1, 1).reshape(n, -1).astype(np.float32) / 255.0
    constants = [
        numpy_helper.from_array(value, name)
        for name, value in {
            "known": 2.0 * known.T, "length": (known**2).sum(axis=1), "answers": label_maps,
        }.items()
    ]  # fmt: skip
    sides = [BLOCK, BLOCK]
    nodes = [
        helper.make_node("AveragePool", ["image"], ["m"], kernel_shape=sides, strides=sides),
        helper.make_node("Flatten", ["m"], ["means"]),
        helper.make_node("MatMul", ["means", "known"], ["product"]),
        helper.make_node("Sub", ["product", "length"], ["likeness"]),
        helper.make_node("ArgMax", ["likeness"], ["which"], axis=1, keepdims=0),
        helper.make_node("Gather", ["answers", "which"], ["answer"], axis=0),
        helper.make_node("Cast", ["answer"], ["labels"], to=TensorProto.INT64),
    ]
    told = helper.make_tensor_value_info("labels", TensorProto.INT64, [1, *label_maps.shape[1:]])
    return _save(path, nodes, [_image(width, height)], [told], constants)


def choosy(path: Path, size: tuple[int, int]) -> Path:
    """A model that says to take images of any size, and runs on one alone."""
    shape = numpy_helper.from_array(np.array([1, 3, size[1], size[0]]), "shape")
    nodes = [helper.make_node("Reshape", ["image", "shape"], ["logits"])]
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 3, size[1], size[0]])
    return _save(path, nodes, [_image("width", "height")], [logits], [shape])


def describe(onnx_file: Path, size: tuple[int, int], **told: Any) -> Path:
    """The TOML beside a model: of a segmenter, or with what is told instead."""
    settings = {
        "model": onnx_file.name,
        "kind": "segmentation",
        "labels": LABELS,
        "outputs": ["logits"],
        **told,
        "input": {"width": size[0], "height": size[1], **told.get("input", {})},
        "classes": told.get("classes", {"pole": "pole", "traffic sign": "sign"}),
    }
    path = onnx_file.with_suffix(".toml")
    path.write_text(tomli_w.dumps(settings))
    return path


def _image(width: int | str, height: int | str) -> Any:
    return helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, height, width])


def _save(
    path: Path, nodes: list[Any], inputs: list[Any], outputs: list[Any], constants: list[Any]
) -> Path:
    graph = helper.make_graph(nodes, "planted", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, path)
    return path
