"""What a user's own methods and domains were registered with, in words that tell two of one name apart.

They are part of the keys of pieces: an edited plugin makes new pieces instead of reusing old ones. What the library
brings along has no definition; its revision says what it is. The code of functions and classes is not part of one, only
their names.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import re
from typing import Any

from crptpro.domains import get_domain
from crptpro.errors import CRPTproError
from crptpro.objectives import Method


def method_definition(method: Method) -> str:
    """Return what a user's own method was registered with, as JSON; empty for those of the library.

    Raises:
        CRPTproError: an option is an object that is called otherwise in every process.
    """
    return "" if method.is_builtin else _as_json(method.describe(), f"method {method.name!r}")


def domain_definition(name: str) -> str:
    """Return what a user's own domain was registered with, as JSON; empty for dm_control's and Gymnasium's.

    Args:
        name: of the domain or of its task.

    Raises:
        CRPTproError: as of :func:`method_definition`.
    """
    domain = get_domain(name)
    if domain.source != "own":
        return ""
    fields = {field.name: getattr(domain, field.name) for field in dataclasses.fields(domain)}
    return _as_json(fields, f"domain {domain.name!r}")


def _as_json(content: dict[str, Any], whose: str) -> str:
    def in_words(value: Any) -> Any:
        if isinstance(value, functools.partial):
            return {"partial": value.func, "args": list(value.args), "keywords": value.keywords}
        if callable(value) and hasattr(value, "__qualname__"):
            return f"{value.__module__}.{value.__qualname__}"
        text = repr(value)
        if re.search(r"\bat 0x[0-9a-f]+", text):
            raise CRPTproError(
                f"The {whose} was registered with {text}, which is called otherwise in every process, so that nothing "
                "made with it would be found again. Use plain values, functions or classes, or give it a __repr__."
            )
        return text

    return json.dumps(content, sort_keys=True, default=in_words)
