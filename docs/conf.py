"""How the documentation site is built: `scripts/docs`."""

import importlib
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)

project = "crptpro"
author = "the crptpro authors"
html_title = "crptpro"
html_theme = "furo"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
smartquotes_action = "D"  # dashes alone
toc_object_entries = False
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
# Pages lie where a reader of the repository finds them, so the root is the source and this is the list of pages.
root_doc = "docs/index"
include_patterns = ["*.md", "docs/*.md", "benchmarks/README.md", "results/README.md", "results/*/README.md",
                    "results/*/report.md"]  # fmt: skip
root = Path(__file__).resolve().parent.parent
exclude_patterns = [p.name for p in root.iterdir() if p.is_dir() and p.name not in ("docs", "benchmarks", "results")]
suppress_warnings = ["toc.not_included"]  # the README, and what results link to

myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False


def plain_links(app: Sphinx, docname: str, source: list[str]) -> None:
    """Leave links to directories, and to Markdown that is no page of the site, to readers of the repository."""

    def shown(match: re.Match[str]) -> str:
        target = ((root / docname).parent / match[2].split("#")[0]).resolve()
        page = target.with_suffix("")
        is_hidden = target.is_dir() or (target.is_file() and target.suffix == ".md" and not is_page(page))
        return match[1] if is_hidden and match[2][0] != "#" else match[0]

    def is_page(path: Path) -> bool:
        return path.is_relative_to(root) and str(path.relative_to(root)) in app.project.docnames

    source[0] = re.sub(r"\[([^\]]+)\]\(([^)\s]+)\)", shown, source[0])


def keep_attribute(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Hide an attribute's text from napoleon, which takes what stands before a colon for a type."""
    if what == "attribute":
        app.attribute_lines = {**getattr(app, "attribute_lines", {}), name: list(lines)}


def restore_attribute(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Put the text back after napoleon."""
    if what == "attribute":
        lines[:] = app.attribute_lines[name]


def short_factories(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Write ``...`` for the default of a dataclass field that a function makes, which is no Python otherwise."""
    return signature and signature.replace("<factory>", "..."), returns


def check_reference(app: Sphinx, env: Any, node: nodes.Element, contnode: nodes.Element) -> None:
    """Report a reference to a name of this package that does not exist; one that has no page stays plain text."""
    target = str(node.get("reftarget", ""))
    if node.get("refdomain") != "py" or not target.startswith("crptpro."):
        return
    parts = target.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        if has_path(found, parts[cut:]):
            return
    logger.warning("the reference to %s names nothing that exists", target, location=node)


def has_path(found: Any, names: list[str]) -> bool:
    """Whether attributes, dataclass fields and annotations lead along the names."""
    for name in names:
        if not hasattr(found, name):
            return name in getattr(found, "__annotations__", {})
        found = getattr(found, name)
    return True


def visit_math(self: Any, node: nodes.Element) -> None:
    """Write MathML, which browsers draw without a script or a font from another host."""
    text = re.sub(r"\\[bB]igg?[lr]?(?![a-zA-Z])", "", node.astext())  # the converter knows no sizes
    try:
        self.body.append(tex2mathml(text, as_block=isinstance(node, nodes.math_block)))
    except MathError as reason:
        logger.warning("a formula cannot be drawn: %s", reason, location=node)
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Connect the functions of this file."""
    app.connect("source-read", plain_links)
    app.connect("autodoc-process-docstring", keep_attribute, priority=400)
    app.connect("autodoc-process-docstring", restore_attribute, priority=600)
    app.connect("autodoc-process-signature", short_factories)
    app.connect("missing-reference", check_reference)
    app.add_html_math_renderer("mathml", inline_renderers=(visit_math, None), block_renderers=(visit_math, None))


html_math_renderer = "mathml"
