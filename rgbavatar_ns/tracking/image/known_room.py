"""The room behind the person as each picture of a clip shows it, though the camera may move."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.tracking.image.background import Background, room_shown
from rgbavatar_ns.tracking.image.hair import HairColors, HairSearch
from rgbavatar_ns.tracking.image.room_view import RoomView, laid_on
from rgbavatar_ns.tracking.image.unsure_band import RoomColors


@dataclass(frozen=True)
class PictureRoom:
    """The room as one picture shows it, and how hair is found before it."""

    colors: RoomColors
    hair: HairSearch | None


@dataclass(frozen=True)
class KnownRoom:
    """What a look at a clip's background has told of it, as mattes need it."""

    colors: RoomColors
    moves: Bool[np.ndarray, "S S"]
    """Where pictures differ, by the person rather than by the room."""
    hair: HairColors | None
    inside: Bool[np.ndarray, "S S"]
    """Where pictures show what was filmed."""
    view: RoomView | None
    """By which other pictures find the room, if the camera moves."""

    @classmethod
    def of(cls, background: Background, inside: Bool[np.ndarray, "S S"]) -> "KnownRoom | None":
        """None where the background is not known, or a moving camera's too plain to be found."""
        plate, view = background.plate, None
        if plate is None:
            return None
        colors = RoomColors.of_plate(plate)
        if background.kind == "moves":
            # With what is guessed: where the known ends there is no edge.
            view = RoomView.of(np.clip(colors.color, 0, 255).astype(np.uint8), plate.known)
            if view is None:
                return None
        return cls(colors, plate.moves, background.hair, inside, view)

    def behind(
        self, image_rgb: UInt8[np.ndarray, "S S 3"], person: Float[np.ndarray, "S S"]
    ) -> PictureRoom | None:
        """The room of a picture in which a segmentation has found the `person`.

        None where the camera has moved so that the room is not found.
        """
        if self.view is None:
            return self._seen(self.colors, self.moves)
        found = self.view.found_in(image_rgb, room_shown(person, self.inside))
        if found is None:
            return None
        to_here = np.linalg.inv(found.homography)
        moves = laid_on(self.moves.astype(np.uint8), to_here, cv2.INTER_NEAREST) > 0
        return self._seen(self.colors.seen_from(to_here, found.elsewhere), moves)

    def _seen(self, colors: RoomColors, moves: Bool[np.ndarray, "S S"]) -> PictureRoom:
        if self.hair is None:
            return PictureRoom(colors, None)
        search = HairSearch.of(self.hair, colors.variance, colors.known, self.inside, moves)
        return PictureRoom(colors, search)
