"""What the avatar has seen, as the viewer tells it: looked up now and then while it is trained."""

import time
from contextlib import suppress

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.theta_map import ThetaNames
from rgbavatar_ns.driving.transfer import told_beyond
from rgbavatar_ns.plugin.avatar_model import AvatarModel
from rgbavatar_ns.plugin.viewer.driving import training_statistics
from rgbavatar_ns.plugin.viewer.sliders import number_sliders
from rgbavatar_ns.threads import using_threads

_LOOK_INTERVAL_S = 2.0
_LOOK_SHARE = 0.01
"""Of the time, at most, that looking may take."""


class FilmSeen:
    """The film's statistics with the weights of the network, both as they were found last.

    Training changes the weights, and a stream's film grows.
    """

    def __init__(self, model: AvatarModel) -> None:
        self._model = model
        self._names = ThetaNames.of(model.avatar.layout, model.avatar.head.arrays)
        self._next_look_s, self._is_final = 0.0, False
        self._take(self._found())
        labels = {slider.place: slider.label for slider in self.sliders}
        self._labels = [labels[place] for place in range(len(labels))]

    def _found(self) -> TrainingStatistics:
        with using_threads(1):  # The others are training's.
            return training_statistics(self._model)

    def _take(self, found: TrainingStatistics) -> None:
        self.statistics, self.sliders = found, number_sliders(self._names, found)

    def look_again(self, now_s: float, training_state: str | None) -> bool:
        """Look where it is time to, and once after training; says whether it did.

        training_state: of nerfstudio's trainer; None where nothing is trained.
        """
        is_over = training_state == "completed"
        if training_state is None or self._is_final or (now_s < self._next_look_s and not is_over):
            return False
        began_s = time.perf_counter()
        # Training that goes astray is about to end.
        with suppress(torch.linalg.LinAlgError):  # pyright: ignore[reportPrivateImportUsage]
            found = self._found()
            if bool(found.psi_mean.isfinite().all()):
                self._take(found)
        took_s = time.perf_counter() - began_s
        self._next_look_s = now_s + max(_LOOK_INTERVAL_S, took_s / _LOOK_SHARE)
        self._is_final = is_over
        return True

    def beyond(self, theta: Float[Tensor, "#F H"], turns_degrees: Float[Tensor, "#F 3"]) -> str:
        """What of these frames the film did not show, in words (`told_beyond`)."""
        return told_beyond(self.statistics, self._labels, theta, turns_degrees)
