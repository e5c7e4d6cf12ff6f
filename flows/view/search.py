"""The search box: which instances a text means, asked anew with every letter."""

from __future__ import annotations

from dataclasses import replace

from ss_flow.tasks.artifacts import Descriptors
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.semantics.query import QueryParams, QueryResult, Similarity, chosen, similarity


class Search:
    """A run's descriptors, and what reads texts for them."""

    def __init__(self, descriptors: tuple[Descriptors, ...], params: QueryParams, encoder: Model | None) -> None:
        """params: how the run searches. encoder: the network that described the instances; None = colour words."""
        self._descriptors, self.params, self._encoder = descriptors, params, encoder
        self._last: Similarity | None = None

    def __call__(self, text: str, tau_corr: float) -> QueryResult:
        """The instances, the best first. Raises InputError for a text that asks for nothing."""
        if self._last is None or self._last.text != text:  # while the slider moves the text stays
            self._last = similarity(
                self._descriptors,
                text=text,
                prompt=self.params.prompt,
                encoder=self._encoder,
                tau_view=self.params.tau_view,
            )
        return chosen(self._last, params=replace(self.params, tau_corr=tau_corr))
