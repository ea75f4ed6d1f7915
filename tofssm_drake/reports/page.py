"""What the reports share: templates, look, pictures."""

import dataclasses as dc
import html
import importlib.resources
import re

import jinja2
from jinja2.filters import do_mark_safe

from tofssm_drake.reports import figures


@dc.dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of a report in its two widths, as data URIs."""

    wide: str
    narrow: str
    description: str


def make_picture(make, description: str, *args, **options) -> Picture:
    """Draws a figure in both widths.

    Args:
        make: Function that returns the figure and takes `narrow`.
        description: For readers who cannot see it.
        *args: For `make`.
        **options: For `make`.
    """
    return Picture(
        wide=figures.to_data_uri(make(*args, **options)),
        narrow=figures.to_data_uri(make(*args, narrow=True, **options)),
        description=description,
    )


_SYMBOL = re.compile(r"\b([A-Za-z]|alpha|rho)_([A-Za-z]{1,5})\b")
_GREEK = {"alpha": "\u03b1", "rho": "\u03c1"}


def write_symbols(text: str) -> str:
    """Returns HTML of a text: symbols like `T_stop` as one reads them."""

    def write(match):
        base, index = match.groups()
        return f"{_GREEK.get(base, base)}<sub>{index}</sub>"

    return do_mark_safe(_SYMBOL.sub(write, html.escape(text)))


def render_page(template: str, *, room: str = __package__, **values) -> str:
    """Returns a page as one HTML document that needs no other file.

    Args:
        template: File name of a template.
        room: Package that has the template; it may include those next to
            this module.
        **values: What it asks for; a missing one is an error.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [_make_loader(room), _make_loader(__package__)]
        ),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["symbols"] = write_symbols
    return environment.get_template(template).render(**values).lstrip()


def _make_loader(room):
    """Returns a loader of the templates of one package."""
    folder = importlib.resources.files(room)

    def load(name):
        file = folder.joinpath(name)
        return file.read_text(encoding="utf-8") if file.is_file() else None

    return jinja2.FunctionLoader(load)
