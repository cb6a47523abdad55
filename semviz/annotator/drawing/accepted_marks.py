"""The edits that accept marks as the page showed them, each like a drawing."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from semviz.annotator.messages import DrawnMark
from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import Labels


def accepted(
    marks: Iterable[DrawnMark], labels: Labels, add: Callable[[DrawnMark], AddObservation]
) -> tuple[AddObservation, ...]:
    """Return the edits that add marks; ``add`` returns that of one mark alone."""
    by_element: dict[str, list[DrawnMark]] = defaultdict(list)
    for mark in marks:
        by_element[mark.element_id].append(mark)
    return tuple(row for group in by_element.values() for row in _of_one(group, labels, add))


def unlabelled(marks: Sequence[DrawnMark], labels: Labels) -> tuple[Sequence[DrawnMark], str]:
    """Return marks without those whose element somebody labelled in that image meanwhile.

    And a message for the user, if there are some. All of them, if nothing else is left.
    """
    free = [mark for mark in marks if not _is_labelled(mark, labels)]
    if len(free) in (0, len(marks)):
        return marks, ""
    return free, f"{len(marks) - len(free)} of {len(marks)} were labelled meanwhile: theirs stay."


def _is_labelled(mark: DrawnMark, labels: Labels) -> bool:
    if mark.element_id not in labels.elements or mark.second is not None:
        return False
    return labels.find(mark.element_id, mark.frame_index, mark.side) is not None


def _of_one(
    marks: list[DrawnMark], labels: Labels, add: Callable[[DrawnMark], AddObservation]
) -> Iterator[AddObservation]:
    """Add the marks of one element; those of a new element join another if all of them do."""
    additions = [add(mark) for mark in marks]
    element_ids = {addition.element_id for addition in additions}
    if len(element_ids) == 1 and all(addition.class_id is None for addition in additions):
        yield from additions
        return
    element_id = marks[0].element_id
    class_id = next(mark.class_id for mark in marks if mark.class_id is not None)
    is_new = element_id not in labels.elements
    for n, addition in enumerate(additions):
        first = is_new and n == 0  # creates the element
        yield replace(addition, element_id=element_id, class_id=class_id if first else None)
