"""What in a map cannot be right, or is worth a look: rules over elements, labels and images.

A rule names the elements, says in one sentence with numbers what is odd, and which frame shows it.
Most need no labels, so maps from elsewhere can be looked over too.
"""

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.labelled import check_frame
from semviz_annotation.mapping.quality.linting import looking, standing, together
from semviz_annotation.mapping.quality.linting.case import Case, Rule
from semviz_annotation.mapping.quality.linting.finding import SEVERITIES, Finding, Severity
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source

__all__ = ["RULES", "SEVERITIES", "Finding", "Severity", "lint"]

RULES: tuple[Rule, ...] = (
    standing.leaning_pole,
    standing.odd_length,
    standing.off_the_ground,
    standing.where_the_car_drove,
    looking.behind_the_camera,
    looking.wrong_side,
    looking.narrow_rays,
    looking.never_seen_again,
    together.class_conflict,
    together.duplicate_nearby,
    together.sign_without_post,
)


def lint(semantic_map: SemanticMap, labels: Labels, source: Source) -> tuple[Finding, ...]:
    """Everything the rules find, the worst first, then rule by rule.

    Raises SemvizError where the map is of another frame than the images.
    """
    check_frame(semantic_map, source)
    case = Case(semantic_map, labels, source)
    found = [finding for rule in RULES for finding in rule(case)]
    return tuple(sorted(found, key=lambda one: SEVERITIES.index(one.severity)))
