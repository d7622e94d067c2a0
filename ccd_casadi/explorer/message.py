"""All that an answer changes on the page, as one message: what to set, and one array of numbers."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.core.properties import Any as Anything
from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.model import DataModel, Model
from bokeh.models import CustomJS

from ccd_casadi.support.package_text import package_text

Change = tuple[Model, dict[str, Any]]  # a model, and new values of its properties


class Message(DataModel):
    """Its content reaches every figure in one piece.

    Models are told by their ids: references would make the server walk through the whole document.
    Each array by itself would be two more frames on the socket. All else is one text: lists would
    be walked through twice, 3 ms a drag.
    """

    content: Any = Anything(default=None)

    def applied_in(self, document: Document) -> None:
        """Have the browser apply what comes, and what came before the page was there."""
        apply = CustomJS(args={"message": self}, code=package_text("explorer/assets/apply.js"))
        self.js_on_change("content", apply)
        document.js_on_event(DocumentReady, apply)

    def send(self, words: Mapping[str, str], changes: Sequence[Change]) -> None:
        """Set the HTML of elements of the page by their ids, and properties of models."""
        found, numbers = packed(changes)
        self.content = [json.dumps([dict(words), found], allow_nan=False), numbers]


def packed(changes: Sequence[Change]) -> tuple[list[Any], np.ndarray]:
    """Changes by the models' ids, where an array tells its place in the one of all numbers."""
    arrays: list[np.ndarray] = []
    taken = 0

    def place(value: Any) -> Any:
        nonlocal taken
        if isinstance(value, list) and value and all(isinstance(each, float) for each in value):
            value = np.array(value)  # NaN is no JSON
        if isinstance(value, list):
            return [place(each) for each in value]
        if not isinstance(value, np.ndarray):
            return value
        arrays.append(np.asarray(value, float))
        taken += len(value)
        return {"from": taken - len(value), "count": len(value)}

    found = []
    for model, values in changes:
        if "data" in values:
            columns = {name: place(column) for name, column in values["data"].items()}
            values = values | {"data": columns}
        found.append([model.id, values])
    return found, np.concatenate([np.empty(0), *arrays])
