"""What commands are given: a study's folder or a problem's name, a fit that is there already, and where results go."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.models import PROBLEMS, VECTORS, no_study

if TYPE_CHECKING:
    import det2stoc_bayes.study  # a dotted name, so that the checker of the tests can look it up

KINDS = ("a study's folder", *PROBLEMS)


def new_folder(text: str, metavar: str = "DIR") -> Any:
    """The option for a folder that results go to; an empty name, as of a variable that is not set, is none."""

    def named(value: str) -> Path:
        if not value.strip():
            raise typer.BadParameter(f"found '{value}'; allowed: a folder's name, . for the present one")
        return Path(value)

    return typer.Option(metavar=metavar, help=text, show_default=False, parser=named)


def study_or_problem(given: str, more: tuple[str, ...] = ()) -> "det2stoc_bayes.study.Study | str":
    """A study that is read, or the name of a problem (of `more`, too); a folder goes before a problem of its name."""
    from det2stoc_bayes.suggestions import choices

    if not given:
        raise Det2StocError(f"the study: found nothing; {choices(given, (*KINDS, *more))}")
    if Path(given).exists() or len(Path(given).parts) > 1:
        return load(Path(given))
    if given in VECTORS and given not in more:
        raise no_study(given)
    if given not in (*PROBLEMS, *more):
        raise Det2StocError(f"{given}: no such folder or problem; {choices(given, (*KINDS, *more))}")
    return given


def made_by(path: Path) -> str:
    """How a fit that is there was made, as ` (laplace, seed 0)`; empty where that cannot be read."""
    from det2stoc_bayes import posterior

    try:
        attributes = posterior.load(path).attrs
    except Det2StocError:
        return ""
    return f" ({attributes['method']}, seed {attributes['seed']})"


def load(folder: Path) -> "det2stoc_bayes.study.Study":
    """A study that is read."""
    from det2stoc_bayes.study import load_study

    return load_study(folder)
