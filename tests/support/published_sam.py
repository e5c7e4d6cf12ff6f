"""Segment Anything's decoder as it was published: what the one written down here is compared with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx

from ss_flow.tasks.artifacts import Float32, Float64, Int32
from ss_flow.tasks.models.onnx import load_onnxruntime
from ss_flow.tasks.models.sam import LOW, Embedding

INNER = "/Reshape_9_output_0", "/iou_prediction_head/layers.2/Gemm_output_0"
"""The four masks, and the IoU predicted for each, inside the published graph, which itself gives one of them."""


def published(file: Path, embedding: Embedding) -> Callable[[Float64, Int32], tuple[Float32, Float32]]:
    """Points [n, 2] in pixels of the photo and their labels [n], one prompt -> logits [4, 256, 256], predicted IoU [4].

    On one thread.
    """
    network = onnx.load(file)
    network.graph.output.extend(
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None) for name in INNER
    )
    runtime = load_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(network.SerializeToString(), options, providers=["CPUExecutionProvider"])
    same = {
        "image_embeddings": embedding.features,
        "mask_input": np.zeros((1, 1, LOW, LOW), np.float32),
        "has_mask_input": np.zeros(1, np.float32),
        "orig_im_size": np.array([embedding.height, embedding.width], np.float32),
    }

    def answer(points: Float64, labels: Int32) -> tuple[Float32, Float32]:
        prompt = {
            "point_coords": np.append(points * embedding.scale, [[0, 0]], axis=0)[None].astype(np.float32),
            "point_labels": np.append(labels, -1)[None].astype(np.float32),
        }
        logits, predicted_iou = session.run(INNER, same | prompt)
        return logits[0], predicted_iou[0]

    return answer
