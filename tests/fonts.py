"""Two sets of fonts for Chromium, so that pages look the same on every machine that tests them.

Both come with matplotlib: DejaVu Sans, as wide as Verdana, and STIX, as narrow as Times. What a
system has of its own is out of the browser's sight.
"""

from pathlib import Path

import matplotlib

FONTS = {"wide": ("DejaVu Sans", "DejaVu Sans Mono"), "narrow": ("STIXGeneral", "cmtt10")}
"""Each set's font for texts and the one for code."""

_RULE = """<match target="pattern">
  <test name="family" qual="any"><string>{generic}</string></test>
  <edit name="family" mode="prepend" binding="strong"><string>{family}</string></edit>
</match>"""

_FILE = """<?xml version="1.0"?>
<!DOCTYPE fontconfig SYSTEM "fonts.dtd">
<fontconfig>
<dir>{fonts}</dir>
<cachedir>{cache}</cachedir>
{rules}
</fontconfig>
"""


def font_settings(name: str, folder: Path) -> dict[str, str]:
    """Environment in which a browser draws with one of ``FONTS``; its files go into ``folder``."""
    generic = zip(("sans-serif", "monospace"), FONTS[name], strict=True)
    rules = "\n".join(
        _RULE.format(generic=generic_name, family=family) for generic_name, family in generic
    )
    path = folder / f"{name}.conf"
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    path.write_text(_FILE.format(fonts=fonts, cache=folder / "cache", rules=rules))
    return {"FONTCONFIG_FILE": str(path)}
