"""semviz report"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from semviz_core.errors import SemvizError

Format = Literal["html", "md", "latex"]
FORMATS: dict[str, Format] = {".html": "html", ".htm": "html", ".md": "md", ".tex": "latex"}


@dataclass(frozen=True)
class Report:
    """Write what runs were, how good they are and where they failed: one page that needs no
    network, or the tables alone."""

    runs: Positional[tuple[Path, ...]]
    """Runs (.rrd), side by side; the first is what the others are held against."""
    out: Path = Path("report.html")
    """The file to write; its ending (.html, .md, .tex) tells the format."""
    format: Literal["by ending", "html", "md", "latex"] = "by ending"
    """html: the whole report; md, latex: its tables."""
    pictures: int = 6
    """So many frames of each run are shown as pictures, at most: the worst of each verdict."""

    def run(self) -> int:
        from semviz.reporting.facts import load_reported
        from semviz.reporting.page import as_html
        from semviz.reporting.texts import as_latex, as_markdown
        from semviz_core.files import check_replaceable, replacing

        if not self.runs:
            raise SemvizError("name at least one run, such as town/runs/first.rrd")
        if self.pictures < 0:
            raise SemvizError(f"--pictures {self.pictures}: give 0 or more")
        kind = self._format()
        check_replaceable(self.out)
        reported = load_reported(self.runs)
        if kind == "html":
            text = as_html(reported, self.pictures)
        else:
            text = as_markdown(reported) if kind == "md" else as_latex(reported)
        with replacing(self.out) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
        print(f"{self.out}: {len(text.encode()) / 1000:.0f} kB")
        return 0

    def _format(self) -> Format:
        if self.format != "by ending":
            return self.format
        if self.out.suffix not in FORMATS:
            raise SemvizError(
                f"{self.out}: a name that ends in {', '.join(FORMATS)} tells the format; or say "
                "--format"
            )
        return FORMATS[self.out.suffix]
