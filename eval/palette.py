"""The colours of all figures, told apart by the colour-blind too."""

from __future__ import annotations

from typing import Final

BLUE: Final = "#0067A9"
ORANGE: Final = "#D98200"
GREEN: Final = "#009E73"
RED: Final = "#CC0000"
PURPLE: Final = "#7B3294"
DARK: Final = "#4D4D4D"
GREY: Final = "#8C8C8C"
LIGHT: Final = "#B0B0B0"
