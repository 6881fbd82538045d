"""Help of a command: every option, or without the settings that few need."""

from typing import TYPE_CHECKING, Final

from cyclopts.help.formatters import DefaultFormatter

if TYPE_CHECKING:
    from cyclopts.help import HelpEntry, HelpPanel
    from rich.console import Console, ConsoleOptions

ESSENTIAL: Final = (  # options of groups that `--help` explains; the others are in `--help-all`
    *("--limits.range-max", "--spline.degree", "--spline.size-share", "--motion.doubt", "--sides.colourless"),
    *("--batch.start", "--odometry.sigma-scale", "--calibration.sensor", "--calibration.trust"),
)


class Help(DefaultFormatter):
    """Help with every option, or if `short` without most options of groups, whose names stand below it."""

    def __init__(self, short: bool) -> None:
        super().__init__()
        self.short = short

    def __call__(self, console: "Console", options: "ConsoleOptions", panel: "HelpPanel") -> None:
        shown, hidden = list["HelpEntry"](), dict[str, None]()
        for entry in panel.entries:
            name = "".join(entry.positive_names[:1])
            if self.short and "." in name and name not in ESSENTIAL:
                hidden[f"{name.split('.')[0]}.*"] = None
            else:
                text = " ".join(entry.description.primary_renderable.plain.split())
                shown.append(entry.copy(description=text.split(". ")[0] if self.short else text))
        super().__call__(console, options, panel.copy(entries=shown))
        if hidden:
            console.print(f"--help-all also explains {', '.join(hidden)}", highlight=False, markup=False)
