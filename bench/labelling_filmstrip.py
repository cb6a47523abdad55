"""The scripted annotator at the filmstrip: it drags or leaves out what is wrong in a cell."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from drives import SIDES
from labelling_truth import RIGHT_PX, Truth, is_about, why_wrong

from semviz.annotator.proposals.proposal_views import ProposalView

if TYPE_CHECKING:
    from labelling_driver import Labeller


LEAST_DRAG = 4.0
"""CSS pixels; the page takes less for a click, and nobody sees that a pole's end is off by less."""
IS_IN_VIEW = """(node) => {
    const [own, all] = [node, node.closest(".scroll")].map((one) => one.getBoundingClientRect());
    return own.top >= all.top && own.bottom <= all.bottom;
}"""


@dataclass(frozen=True)
class Cell:
    """What is proposed for an element in a frame, and the element that it is right for."""

    key: str
    frame: int
    offer: ProposalView
    is_taken: bool
    element: int | None


class FilmstripHand:
    """The hand of a ``Labeller`` on the filmstrip."""

    def __init__(self, labeller: "Labeller", truths: Mapping[int, Truth]) -> None:
        self.labeller = labeller
        self.truths = truths

    def wait(self) -> None:
        """Until the strip is there, and its images are searched."""
        self.labeller.page.wait_for_function(
            "() => semviz.state.view === 'filmstrip' && semviz.filmstrip.found.size"
            " && !semviz.filmstrip.isSearching"
        )

    def missed(self, frame: int) -> list[int]:
        """Elements to be labelled in a frame that no cell is for: neither rightly nor wrongly."""
        truth = self.truths[frame]
        cells = [cell for cell in self.cells() if cell.frame == frame]
        covered = {cell.element for cell in cells} | {self.lacked(cell) for cell in cells}
        return [
            element
            for element in truth.wanted
            if element not in covered and self.labeller.lacking(frame, truth, element)
        ]

    def judge(self) -> bool:
        """Correct and leave out what is wrong; return whether the last key takes weak ones too.

        They are taken together if fewer of them are wrong than right: by that key, or marked first
        if some are to be left out.
        """
        corrected, work = self.correct_all(), self.labeller.work
        cells = [cell for cell in self.cells() if cell.key not in corrected]
        weak = [cell for cell in cells if not cell.is_taken]
        right = [cell for cell in weak if cell.element is not None]
        takes_weak = len(right) >= max(len(weak) - len(right), 1)
        marks_first = takes_weak and any(cell.element is None for cell in weak)
        if marks_first:
            with work.on("strip: weak but right", cells[0].frame):
                self.labeller.key("Shift+G")
        for cell in cells:
            is_accepted = cell.is_taken or takes_weak
            if is_accepted == (cell.element is None):
                cause = "strip: sure but wrong" if cell.is_taken else "strip: weak and wrong"
                cause = cause if is_accepted else "strip: weak but right"
                with work.on(
                    cause,
                    cell.frame,
                    f"{cell.offer.name} {why_wrong(cell.offer, self.truths[cell.frame])}",
                    class_id=cell.offer.class_id,
                ):
                    self.click(cell)
        return takes_weak and not marks_first

    def correct_all(self) -> set[str]:
        """Drag what is off, and return the keys of these cells. What follows a correction of its
        row is looked at again after that."""
        corrected: set[str] = set()
        while wrong := self.first_wrong(corrected):
            self.correct(*wrong)
            corrected.add(wrong[0].key)
        return corrected

    def first_wrong(self, corrected: set[str]) -> tuple[Cell, int] | None:
        """The first cell, frame by frame, that is off and was not corrected, and what it means."""
        for cell in self.cells():
            if cell.key not in corrected and cell.element is None:
                element = self.lacked(cell)
                if element is not None:
                    return cell, element
        return None

    def now(self, key: str) -> Cell | None:
        """A cell as it is after the corrections so far: they are followed along its row."""
        return next((cell for cell in self.cells() if cell.key == key), None)

    def cells(self) -> list[Cell]:
        shown = self.labeller.page.evaluate(
            "semviz.filmstrip.cells.map((cell) => [cell.key, cell.frame, cell.proposal,"
            " semviz.filmstrip.isTaken(cell)])"
        )
        offers = [
            (key, frame, ProposalView.model_validate(offer), taken)
            for key, frame, offer, taken in shown
        ]
        return [
            Cell(key, frame, offer, taken, self.labeller.meant(offer, self.truths[frame]))
            for key, frame, offer, taken in offers
        ]

    def lacked(self, cell: Cell) -> int | None:
        """The element that a wrong proposal is meant for, if that is to be labelled."""
        truth = self.truths[cell.frame]
        for element in truth.wanted:
            alike = truth.class_id[element] == cell.offer.class_id
            if (
                alike
                and is_about(cell.offer, truth, element)
                and self.labeller.lacking(cell.frame, truth, element)
            ):
                return element
        return None

    def correct(self, cell: Cell, element: int) -> None:
        """Drags what is off to where it belongs; the cell is taken then, and the other images
        follow."""
        truth = self.truths[cell.frame]
        why = why_wrong(cell.offer, truth)
        self.labeller.work.thoughts += 1
        about = f"{cell.offer.name}: {why}"
        with self.labeller.work.on(
            "strip: corrected", cell.frame, about, element, cell.offer.class_id
        ):
            for side in SIDES:
                mark = (self.now(cell.key) or cell).offer.marks.get(side)
                if mark is None or side not in truth.marks[element]:
                    continue
                if truth.is_right(element, side, mark.anchor, mark.end) and truth.are_ends_right(
                    element, side, mark
                ):
                    continue
                anchor, end = truth.marks[element][side]
                places = [(np.array(mark.anchor), anchor)]
                if mark.end is not None:
                    places.append((np.array(mark.end), end))
                self.drag(cell, side, places)

    def drag(self, cell: Cell, side: str, places: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Drags a sign, a pole as a whole, or its ends if one drag does not do."""
        moves = [to - now for now, to in places]
        common = np.mean(moves, axis=0)
        is_common = all(np.abs(move - common).max() < RIGHT_PX / 2.0 for move in moves)
        now = np.mean([now for now, _ in places], axis=0)
        if is_common and self.is_seen(cell, side, now, now + common):
            self.one_drag(cell, side, now, now + common)
            return
        for now, to in places:
            if np.linalg.norm(to - now) > RIGHT_PX / 2.0 and self.is_seen(cell, side, now, to):
                self.one_drag(cell, side, now, to)

    def is_seen(self, cell: Cell, side: str, now: np.ndarray, to: np.ndarray) -> bool:
        """Whether a mark is visibly off."""
        _, crop = self.canvas(cell, side)
        on_screen = np.subtract(self.on_crop(crop, to), self.on_crop(crop, now))
        return bool(np.hypot(*on_screen) > LEAST_DRAG)

    def one_drag(self, cell: Cell, side: str, now: np.ndarray, to: np.ndarray) -> None:
        """Drags again if that was so short that it took or left out the cell."""
        hand, mark = self.labeller, cell.offer.marks[side].id
        placed = f"JSON.stringify(semviz.filmstrip.placed.get('{mark}'))"
        before = hand.page.evaluate(placed)
        while hand.page.evaluate(placed) == before:
            hand.work.clicks += 2
            box, crop = self.canvas(cell, side)
            start, stop = (np.array(self.on_crop(crop, point)) for point in (now, to))
            stop = stop + hand.tremor()
            mouse = hand.page.mouse
            mouse.move(box["x"] + start[0], box["y"] + start[1])
            mouse.down()
            mouse.move(box["x"] + stop[0], box["y"] + stop[1], steps=4)
            mouse.up()
        self.wait()

    def click(self, cell: Cell) -> None:
        self.labeller.work.clicks += 1
        box, _ = self.canvas(cell, next(side for side in SIDES if side in cell.offer.marks))
        self.labeller.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def canvas(self, cell: Cell, side: str) -> tuple[Any, Any]:
        """Where a crop is on the page, and what it shows."""
        node = self.labeller.page.locator(f'[data-cell="{cell.key}"] canvas[data-side="{side}"]')
        if not node.evaluate(IS_IN_VIEW):
            self.labeller.work.clicks += 1
            node.scroll_into_view_if_needed()
        return node.bounding_box(), json.loads(node.get_attribute("data-crop") or "{}")

    @staticmethod
    def on_crop(crop: Any, pixel: np.ndarray) -> np.ndarray:
        offset = (pixel - np.array(crop["middle"])) * np.array(crop["zoom"])
        return np.asarray(offset + np.array(crop["size"]) / 2.0)
