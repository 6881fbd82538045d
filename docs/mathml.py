"""Hook of the site's build: convert formulas to MathML, so that no page loads a script from another host."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', flags=re.DOTALL)
BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', flags=re.DOTALL)


def on_page_content(text: str, **_: Any) -> str:
    """Replace the formulas that arithmatex has marked."""
    text = INLINE.sub(lambda found: convert(html.unescape(found[1])), text)
    return BLOCK.sub(lambda found: convert(html.unescape(found[1]), display="block"), text)
