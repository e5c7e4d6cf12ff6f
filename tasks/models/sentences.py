"""MiniLM: unit vectors of short texts, near each other where the texts mean much the same (Reimers and Gurevych,
"Sentence-BERT"; Wang et al., "MiniLM"). The network is BERT's encoder (Devlin et al.), of six layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Float32
from ss_flow.tasks.models.onnx import open_written, run
from ss_flow.tasks.models.onnx_graph import GraphWriter
from ss_flow.tasks.models.text_image import unit_rows

_HEADS = 12
_EPSILON = 1e-12
"""Of layer normalisation, as the network was trained."""
_MOST_TOKENS = 256
_BATCH = 64
_EMBEDDINGS = "embeddings"


class SentenceEncoder:
    """The network, given by its weights (safetensors) and its tokenizer (tokenizer.json)."""

    def __init__(self, weights: FileRef, tokenizer: FileRef) -> None:
        """Raises InputError when a file is missing or damaged, or of another network."""
        from safetensors import SafetensorError, safe_open
        from safetensors.numpy import load_file
        from tokenizers import Tokenizer

        try:
            with safe_open(weights.path, framework="numpy") as file:
                names = [name for name in list(file.keys()) if name.startswith(_EMBEDDINGS)]
                tables = {name: file.get_tensor(name) for name in names}
            self._tokenizer = Tokenizer.from_file(str(tokenizer.path))
        except (OSError, SafetensorError, ValueError) as error:
            raise InputError(f"{weights.path.parent} holds no sentence encoder ({error}); install it again.") from error
        self._tokenizer.no_padding()
        self._tokenizer.enable_truncation(_MOST_TOKENS)
        self._words = tables[f"{_EMBEDDINGS}.word_embeddings.weight"]
        # Every text is the first segment, so its segment's vector goes to each place alike.
        first_segment = tables[f"{_EMBEDDINGS}.token_type_embeddings.weight"][0]
        self._places = tables[f"{_EMBEDDINGS}.position_embeddings.weight"] + first_segment
        self._session = open_written(weights, lambda: _network(load_file(weights.path)))

    @property
    def dimension(self) -> int:
        return int(self._words.shape[1])

    def encode(self, texts: Sequence[str]) -> Float32:
        """Unit vectors of texts, the mean over their tokens: [n, D].

        Texts of as many tokens go through the network together; none is filled up, so no mask is needed.
        """
        tokens = [encoded.ids for encoded in self._tokenizer.encode_batch(list(texts))]
        rows = np.zeros((len(texts), self.dimension), np.float32)
        for length in sorted({len(ids) for ids in tokens}):
            alike = [row for row, ids in enumerate(tokens) if len(ids) == length]
            for start in range(0, len(alike), _BATCH):
                some = alike[start : start + _BATCH]
                embedded = self._words[np.array([tokens[row] for row in some])] + self._places[:length]
                rows[some] = run(self._session, {"embedded": embedded})[0]
        return unit_rows(rows)


def _network(weights: Mapping[str, Float32]) -> bytes:
    """BERT's encoder from embedded tokens [n, t, D] to the mean of its last layer [n, D].

    Raises KeyError when a weight is missing.
    """
    graph = GraphWriter(weights)
    layers = sum(name.endswith(".attention.self.query.weight") for name in weights)
    tensor = graph.normalised("embedded", f"{_EMBEDDINGS}.LayerNorm", _EPSILON)
    for number in range(layers):
        layer = f"encoder.layer.{number}"
        seen = graph.linear(_attention(graph, tensor, f"{layer}.attention.self"), f"{layer}.attention.output.dense")
        tensor = graph.normalised(graph.operator("Add", seen, tensor), f"{layer}.attention.output.LayerNorm", _EPSILON)
        wide = graph.operator("Gelu", graph.linear(tensor, f"{layer}.intermediate.dense"))
        narrow = graph.linear(wide, f"{layer}.output.dense")
        tensor = graph.normalised(graph.operator("Add", narrow, tensor), f"{layer}.output.LayerNorm", _EPSILON)
    mean = graph.operator("ReduceMean", tensor, np.array([1], np.int64), keepdims=0)
    width = weights[f"{_EMBEDDINGS}.LayerNorm.weight"].shape[0]
    return graph.finished({"embedded": ("n", "t", width)}, mean)


def _attention(graph: GraphWriter, tensor: str, name: str) -> str:
    """Scaled dot-product attention of all heads (Vaswani et al., "Attention Is All You Need", Eq. 1)."""
    width = graph.weights[f"{name}.query.weight"].shape[0]

    def heads(kind: str, order: tuple[int, ...]) -> str:
        split = np.array([0, 0, _HEADS, width // _HEADS], np.int64)
        return graph.operator(
            "Transpose", graph.operator("Reshape", graph.linear(tensor, f"{name}.{kind}"), split), perm=order
        )

    queries, keys, values = heads("query", (0, 2, 1, 3)), heads("key", (0, 2, 3, 1)), heads("value", (0, 2, 1, 3))
    scale = np.array((width // _HEADS) ** -0.5, np.float32)
    shares = graph.operator("Softmax", graph.operator("Mul", graph.operator("MatMul", queries, keys), scale), axis=-1)
    mixed = graph.operator("Transpose", graph.operator("MatMul", shares, values), perm=(0, 2, 1, 3))
    return graph.operator("Reshape", mixed, np.array([0, 0, width], np.int64))
