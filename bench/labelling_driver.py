"""The scripted annotator: it uses the labelling page in a browser as a person does."""

from collections.abc import Iterator, Sequence

import numpy as np
from drives import SIDES, Drive
from labelling_filmstrip import FilmstripHand
from labelling_hand import FIRST, FRAME, STRIP, Hand
from labelling_truth import (
    ALONG_M,
    ALONG_PX,
    RIGHT_PX,
    Truth,
    error_px,
    is_about,
    meant,
    told,
    truth_of,
    why_wrong,
)
from playwright.sync_api import Page

from semviz.annotator.drawing.draft import ProposalView
from semviz.annotator.server import Annotator
from semviz_annotation.labels.labels import Labels, Observation
from semviz_core.base.frame import Side

CLOSE_M = 35.0
DRAWN_OVER_PX = 6.0
"""A drawing this near to a weak proposal surely joins its element."""


class Labeller(Hand):
    """Labels a drive through the page."""

    def __init__(
        self, page: Page, annotator: Annotator, drive: Drive, seed: int, tremor_css_px: float
    ) -> None:
        super().__init__(page, seed, tremor_css_px)
        self.annotator = annotator
        self.drive = drive
        self.labelled: set[int] = set()
        """Elements, in any frame."""
        self.taken: set[int] = set()
        """Elements whose proposals in this frame are weak, but right, like all that are weak: the
        frame's key takes them."""
        self.unclear: set[int] = set()
        """Elements whose drawing had to be corrected."""
        self.seen: set[str] = set()
        """Ids of the proposals in this frame that were in view."""

    def label(self, frame: int) -> None:
        """One frame: proposals first, then what is missing; then on to the next."""
        self.work.thoughts += 1
        self.taken = set()
        self.seen = set()
        truth = truth_of(self.drive, frame)
        self.settle()
        self.judge(frame, truth)
        missing = [element for element in truth.wanted if not self.is_here(frame, truth, element)]
        for element in self.in_turn(truth, missing):
            self.draw(frame, truth, element, "left")
        self.settle()
        if missing:
            self.judge(frame, truth)
        for element in truth.wanted:
            if self.lacking(frame, truth, element) and not self.is_offered(frame, truth, element):
                self.draw(frame, truth, element, "right")
        self.finish(frame, truth)
        self.count(frame, truth)

    def label_between(self, frames: Sequence[int]) -> None:
        """The filmstrip of the frames before the one that was labelled last: first what it lacks is
        drawn in its frame, then the strip is accepted."""
        self.work.thoughts += len(frames)
        truths = {frame: truth_of(self.drive, frame) for frame in frames}
        strip = FilmstripHand(self, truths)
        strip.wait()
        for frame in frames:
            if missed := strip.missed(frame):
                self.visit(frame, truths[frame], missed)
                strip.wait()
        with self.work.on(STRIP, frames[0]):
            key = "Control+Shift+Enter" if strip.judge() else "Control+Enter"
            while self.page.evaluate("semviz.state.view") == "filmstrip":  # more rows come
                self.key(key)
        for frame, truth in truths.items():
            self.complete(frame, truth)

    def visit(self, frame: int, truth: Truth, missed: Sequence[int]) -> None:
        """Opens a frame out of the strip, and draws what that lacks; the frame's key leads back."""
        with self.work.on("to a frame of the strip and back", frame):
            self.work.clicks += 1
            self.page.locator(f"#filmstrip-cells button:text-is('Frame {frame}')").click()
            self.draw_missed(frame, truth, missed)
        self.finish(frame, truth)

    def draw_missed(self, frame: int, truth: Truth, missed: Sequence[int]) -> None:
        """Judges what is proposed in a frame, and draws what is not."""
        self.seen = set()
        self.settle()
        self.judge(frame, truth)
        for element in missed:
            for side in SIDES:
                lacks = side in self.lacking(frame, truth, element)
                if lacks and not self.is_offered(frame, truth, element):
                    self.draw(frame, truth, element, side)
                    self.settle()

    def complete(self, frame: int, truth: Truth) -> None:
        """Goes to a frame of the strip if it lacks something after all, and comes back."""
        wanted = [element for element in truth.wanted if self.lacking(frame, truth, element)]
        if wanted:
            last = self.page.evaluate("semviz.state.frame")
            with self.work.on("to an accepted frame and back", frame):
                self.go(frame)
                self.draw_missed(frame, truth, wanted)
                if any(self.lacking(frame, truth, element) for element in wanted):
                    self.key("Shift+G" if self.taken else "Shift+Space")
                self.go(last)
        self.count(frame, truth)

    def go(self, frame: int) -> None:
        """A click on the strip of all frames."""
        if self.zoomed_for is not None:
            self.whole()
        self.work.clicks += 1
        self.page.locator(f'#strip [data-frame="{frame}"]').click()

    def count(self, frame: int, truth: Truth) -> None:
        """Notes what was labelled in a frame."""
        here = {
            mark
            for mark in truth.marks
            if len(self.lacking(frame, truth, mark)) < len(truth.marks[mark])
        }
        self.work.sightings += [(frame, element) for element in sorted(here | set(truth.wanted))]
        self.labelled |= here

    def finish(self, frame: int, truth: Truth) -> None:
        """The frame's key; with what is weak if all of that is right."""
        self.settle()
        self.judge(frame, truth)
        with self.work.on(FRAME, frame):
            self.key("Control+Shift+Enter" if self.taken else "Control+Enter")
        self.zoomed_for = None  # the page shows the next frame whole

    def judge(self, frame: int, truth: Truth) -> None:
        """Turns down what is sure but wrong; it stays selected, and is drawn anew next.

        What is wrong but about an element that is drawn next stays: the drawing takes its place.
        What is weak but right is left to the frame's key, once the weak that is wrong is turned
        down; or accepted one by one, if that takes fewer keys.
        """
        self.look(frame)
        for offer in self.offers(frame):
            if offer.is_confident and self.meant(offer, truth) is None:
                self.turn_down(frame, offer, "sure but wrong: " + why_wrong(offer, truth))
        weak, wrong = self.weak(frame, truth)
        found = self.found()
        together = {id: element for id, (_, element) in weak.items() if id in found}
        self.work.thoughts += bool(together)
        self.taken = set()
        if len(together) >= max(len(wrong), 1):
            self.taken = set(together.values())
            for offer in wrong:
                self.turn_down(frame, offer, "weak and wrong")
        for offer, element in weak.values():
            if element not in self.taken and self.lacking(frame, truth, element):
                with self.work.on("weak but right", frame, told(offer), element, offer.class_id):
                    self.point_at(offer)
                    self.key(" ")

    def look(self, frame: int) -> None:
        """Looks at all that is proposed; zooms out if something was never in view."""
        self.glance(frame)
        if self.zoomed_for is not None and {offer.id for offer in self.offers(frame)} - self.seen:
            self.whole()
            self.glance(frame)

    def glance(self, frame: int) -> None:
        """Sees the proposals that are in view."""
        self.seen |= {offer.id for offer in self.offers(frame) if self.is_offer_in_view(offer)}

    def is_offer_in_view(self, offer: ProposalView) -> bool:
        middles = {
            side: np.mean([one.anchor, one.end or one.anchor], axis=0)
            for side, one in offer.marks.items()
        }
        return self.zoomed_for is None or all(
            self.is_in_view(side, middles[side][None]) for side in middles
        )

    def turn_down(self, frame: int, offer: ProposalView, cause: str) -> None:
        with self.work.on(cause, frame, told(offer), class_id=offer.class_id):
            self.point_at(offer)
            self.key("x")

    def weak(
        self, frame: int, truth: Truth
    ) -> tuple[dict[str, tuple[ProposalView, int]], list[ProposalView]]:
        """Proposals that are weak but right, by id and with their elements; and those that are
        wrong, but that the key for all would take."""
        right: dict[str, tuple[ProposalView, int]] = {}
        wrong = []
        found = self.found()
        for offer in self.offers(frame):
            if offer.is_confident:
                continue
            element = self.meant(offer, truth)
            if element is not None and self.lacking(frame, truth, element):
                right[offer.id] = offer, element
            elif offer.id in found and not self.is_drawn_over(frame, truth, offer):
                wrong.append(offer)
        return right, wrong

    def is_drawn_over(self, frame: int, truth: Truth, offer: ProposalView) -> bool:
        """Whether an element is drawn next where it is wrongly proposed."""
        return any(
            truth.class_id[element] == offer.class_id
            and is_about(offer, truth, element, DRAWN_OVER_PX)
            and set(offer.marks) & set(self.lacking(frame, truth, element))
            for element in truth.wanted
        )

    def found(self) -> set[str]:
        """Ids of the proposals that the key for all takes."""
        return set(self.page.evaluate("semviz.state.foundProposals.map(({ id }) => id)"))

    def draw(self, frame: int, truth: Truth, element: int, side: Side) -> None:
        """With snapping where its preview is right, without where it isn't; then corrected."""
        self.work.thoughts += 1
        again = element in self.labelled
        cause = "drawn again: " + self.why_again(frame, truth, element) if again else FIRST
        about = f"{truth.named(element)}, {side}"
        before = set(self.labels.in_frame(frame, side))  # a drawing may also move a label
        with self.work.on(cause, frame, about, element, truth.class_id[element]):
            self.set_points(frame, truth, element, side)
        new = [row for row in self.labels.in_frame(frame, side) if row not in before]
        if not new:
            raise SystemExit(f"not drawn; the page says {self.page.text_content('#message')!r}")
        self.correct(truth, element, side, new[0])
        self.labelled.add(element)
        self.glance(frame)

    def zoom_for(self, frame: int, truth: Truth, element: int, side: Side) -> None:
        """Zooms in on what is far away, or had to be corrected before: all that follows a drawing
        keeps its error. What is near it is then drawn at the same zoom."""
        if element not in self.unclear and truth.depth_m[element] < CLOSE_M:
            return
        ends = [end for end in truth.marks[element][side] if np.isfinite(end).all()]
        middle = truth.middle(element, side)
        if not self.is_in_view(side, np.array([middle + 3.0 * (end - middle) for end in ends])):
            return  # it is longer than what the zoom shows
        if self.zoomed_for is None:
            self.page.mouse.move(*self.on_screen(side, middle))
            self.wheel(-1)
            self.zoomed_for = frame, element

    def in_turn(self, truth: Truth, elements: Sequence[int]) -> Iterator[int]:
        """Class by class, and what is near the last one first: at one zoom."""
        left = list(elements)
        last = np.zeros(2)
        while left:
            of_class = [one for one in left if truth.class_id[one] == truth.class_id[left[0]]]
            places = [truth.middle(element, "left") for element in of_class]
            nearest = int(np.argmin([np.linalg.norm(place - last) for place in places]))
            last = places[nearest]
            left.remove(of_class[nearest])
            yield of_class[nearest]

    def see(self, truth: Truth, element: int, side: Side) -> None:
        """Zooms out if an element is not in view."""
        ends = [end for end in truth.marks[element][side] if np.isfinite(end).all()]
        if self.zoomed_for is not None and not self.is_in_view(side, np.array(ends)):
            self.whole()

    def set_points(self, frame: int, truth: Truth, element: int, side: Side) -> None:
        """Class, peak and bottom; or class and middle."""
        if truth.class_id[element] != self.page.evaluate(f"semviz.state.nextClass('{side}')"):
            self.key(str(truth.class_id[element] + 1))
        self.see(truth, element, side)
        if self.take_whole(frame, truth, element, side):
            return
        was_zoomed = self.zoomed_for is not None
        self.zoom_for(frame, truth, element, side)
        is_nearer = self.zoomed_for is not None and not was_zoomed
        if not (is_nearer and self.take_whole(frame, truth, element, side)):
            self.set_points_by_hand(frame, truth, element, side)

    def take_whole(self, frame: int, truth: Truth, element: int, side: Side) -> bool:
        """Click where the page shows the whole pole; return whether that drew it."""
        is_line = bool(np.isfinite(truth.marks[element][side][1]).all())
        if not is_line or not self.is_whole_shown(truth, element, side):
            return False
        self.work.clicks += 1
        before = len(self.labels.in_frame(frame, side))
        self.page.mouse.down()
        self.page.mouse.up()
        self.saved()
        if len(self.labels.in_frame(frame, side)) > before:
            return True
        self.key("Escape")  # something else was under the pointer, and is selected now
        return False

    def set_points_by_hand(self, frame: int, truth: Truth, element: int, side: Side) -> None:
        marks = truth.marks[element][side]
        self.click(side, marks[0])
        if np.isfinite(marks[1]).all():
            peak_known, bottom_known = truth.known[element][side]
            keys = self.drive.tells_hidden
            with self.work.on("keys for hidden ends", frame, "", element, truth.class_id[element]):
                if (
                    keys and not peak_known and not self.is_at_border(marks[0])
                ):  # there the page knows
                    self.key("c")
                self.hover(side, marks[1])
                is_told = self.is_bottom_shown() == bottom_known or self.is_at_border(marks[1])
                if keys and not is_told:
                    self.key("o")
            self.click(side, marks[1], snapped=self.is_preview_right(truth, element, side))
        self.saved()

    def is_whole_shown(self, truth: Truth, element: int, side: Side) -> bool:
        """Whether the page shows the whole pole under the pointer, and rightly: zoomed in, an
        error of a pixel is seen."""
        anchor, end = truth.marks[element][side]
        point = anchor + self.hand.uniform(0.3, 0.7) * (end - anchor)
        self.page.mouse.move(*self.on_screen(side, point, trembles=True))
        self.page.wait_for_function("() => !semviz.tools.ghosts.isBusy")
        ghost = self.page.evaluate("semviz.state.ghost")
        if ghost is None or ghost["side"] != side:
            return False
        shown = ghost["anchor"], ghost["end"]
        if not truth.is_right(element, side, *shown):
            return False
        off_px = error_px(shown, truth.marks[element][side])
        if self.zoomed_for is not None and off_px > RIGHT_PX / 2.0:
            return False
        told = np.array([ghost["anchor_known"], ghost["end_known"]])
        true = np.array(truth.known[element][side])
        gaps = np.linalg.norm(np.array(shown) - truth.marks[element][side], axis=1)
        hidden = ~true & self.drive.tells_hidden
        wrong = told & (hidden | (true & (gaps > truth.within_px(element, ALONG_PX, ALONG_M))))
        return not wrong.any()

    def why_again(self, frame: int, truth: Truth, element: int) -> str:
        """What is proposed for an element that has to be drawn all the same."""
        near = [offer for offer in self.offers(frame) if is_about(offer, truth, element)]
        if not near:
            return "not proposed, or turned down"
        return "weak, " + why_wrong(near[0], truth)

    def is_at_border(self, pixel: np.ndarray) -> bool:
        camera = self.drive.source.rig.left
        return bool(
            (pixel < 2.0).any() or (pixel > [camera.width - 3.0, camera.height - 3.0]).any()
        )

    def is_preview_right(self, truth: Truth, element: int, side: Side) -> bool:
        snapped = self.page.evaluate("semviz.state.preview?.snapped ?? null")
        return snapped is None or truth.is_right(element, side, snapped["anchor"], snapped["end"])

    def is_bottom_shown(self) -> bool:
        """Whether the page takes the bottom under the pen for one that is seen."""
        said = "semviz.state.preview?.snapped?.end_known ?? semviz.state.drawing.end_known"
        return bool(self.page.evaluate(said))

    def correct(self, truth: Truth, element: int, side: Side, row: Observation) -> None:
        """Zooms in and drags the ends of what was just drawn to where they belong."""
        marks = truth.marks[element][side]
        if truth.is_right(element, side, row.anchor_px, row.end_px):
            return
        self.work.thoughts += 1
        self.unclear.add(element)
        ends = [(row.anchor_px, marks[0])] + ([(row.end_px, marks[1])] if row.end_px else [])
        about, class_id = f"{truth.named(element)}, {side}", truth.class_id[element]
        with self.work.on("drawings corrected", row.frame_index, about, element, class_id):
            for drawn, true in ends:
                if np.hypot(*np.subtract(true, drawn)) <= RIGHT_PX / 2.0:
                    continue
                if not self.is_in_view(side, np.array([drawn, true])):
                    self.whole()  # a near pole is longer than what the zoom shows
                if self.zoomed_for is None:
                    self.page.mouse.move(*self.on_screen(side, np.array(drawn)))
                    self.wheel(-1)
                    self.zoomed_for = row.frame_index, element
                self.drag(side, np.array(drawn), true)

    def point_at(self, offer: ProposalView) -> None:
        """The pointer over a proposal, so that the keys are for it; where another is on top of it,
        a click on its row."""
        self.work.thoughts += 1
        self.work.points += 1
        side = "left" if "left" in offer.marks else "right"
        mark = offer.marks[side]
        ends = np.array([point for point in (mark.anchor, mark.end) if point is not None])
        if not self.is_offer_in_view(offer):
            self.whole()
        self.page.mouse.move(*self.on_screen(side, ends.mean(axis=0)))
        if self.page.evaluate("semviz.state.currentProposal?.id") != offer.id:
            shown = "({ elements, expected, nearby }) => [...elements, ...expected, ...nearby]"
            ids = self.page.evaluate(f"({shown})(semviz.state).map((one) => one.id)")
            self.page.locator("#elements .row").nth(ids.index(offer.id)).click()
            self.work.clicks += 1

    # -- what there is

    def offers(self, frame: int) -> list[ProposalView]:
        with self.annotator.lock:
            return self.annotator.session.frame(frame).proposals

    def meant(self, offer: ProposalView, truth: Truth) -> int | None:
        """The element that a proposal is right for; None where that is not the one it is of."""
        element = meant(offer, truth)
        for row in self.labels.of_element(offer.id)[:1]:
            then = truth_of(self.drive, row.frame_index)
            mark = row.side, row.anchor_px, row.end_px
            labelled = [name for name in then.marks if then.is_right(name, *mark)]
            return element if not labelled or element in labelled else None
        return element

    @property
    def labels(self) -> Labels:
        with self.annotator.lock:
            return self.annotator.session.labels

    def is_here(self, frame: int, truth: Truth, element: int) -> bool:
        """Labelled in one of the images, or about to be."""
        return self.is_offered(frame, truth, element) or (
            len(self.lacking(frame, truth, element)) < len(SIDES)
        )

    def is_offered(self, frame: int, truth: Truth, element: int) -> bool:
        """Proposed, and the key at the end takes it."""
        return element in self.taken or any(
            offer.is_confident and self.meant(offer, truth) == element
            for offer in self.offers(frame)
        )

    def lacking(self, frame: int, truth: Truth, element: int) -> list[str]:
        """The images in which an element is to be seen and not labelled."""
        return [
            side
            for side in truth.marks[element]
            if not any(
                truth.is_right(element, side, row.anchor_px, row.end_px)
                for row in self.labels.in_frame(frame, side)
            )
        ]
