"""What verbs return: data, table, report and figures of a result, whatever was asked."""

from __future__ import annotations

from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from studies.results.labelled import Labelled, Variable, document, told, variables
from studies.store import variable_labels, with_coordinates

if TYPE_CHECKING:
    import pandas
    import xarray

R = TypeVar("R", bound="Result")


class Result:
    """Base of what verbs return."""

    #: Where its files are; None: nothing was written.
    folder: Path | None = None
    #: The page of its report; None: there is none.
    report_page: Path | None = None
    #: What else is there, for the line that names the report.
    FILES: ClassVar[str] = ""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]  # not that of all fields

    def __repr__(self) -> str:
        where = "" if self.folder is None else f" in {self.folder}"
        return f"<{type(self).__name__}{where}>"

    @property
    def is_good(self) -> bool:
        """Whether the answer is what one asks for."""
        return True

    @property
    def has_failed(self) -> bool:
        """Whether a command ends with 1."""
        return not self.is_good

    def variables(self) -> dict[str, Variable]:
        """What a file holds of it."""
        return variables(self if isinstance(self, Labelled) else self.document())

    def document(self) -> Labelled:
        """What `--json` prints."""
        if isinstance(self, Labelled) and self.COMMAND:
            return self
        made: Labelled = import_module("studies.cards").document_of(self)
        return made

    def lines(self) -> list[str]:
        """What a command prints of it, where there is a page with the rest."""
        return list(self.report().lines())

    def told(self) -> list[str]:
        """What files there are, in lines."""
        is_file = self.folder is not None and not self.folder.is_dir()
        lines = [f"written: {self.folder}"] if is_file else []
        return [*lines, *([f"report: {self.report_page}{self.FILES}"] if self.report_page else [])]

    @property
    def data(self) -> xarray.Dataset:
        """All numbers, with units and long names."""
        import xarray

        found = with_coordinates(self.variables())
        return xarray.Dataset({x: (v.dims, v.data, variable_labels(v)) for x, v in found.items()})

    def table(self) -> pandas.DataFrame:
        """The records of its document, or else its numbers, one a row."""
        import pandas

        found, whole = self.document(), document(self.document())
        lists = [found.ROWS.name] if found.ROWS else [x for x, y in whole.items() if _is_rows(y)]
        if lists:
            return pandas.DataFrame(whole[lists[0]])
        return pandas.DataFrame({"value": whole})

    def report(self) -> Any:
        """What is told of it, a `studies.show.report.Report`: the same for page and console."""
        return self._report

    @cached_property
    def _report(self) -> Any:
        """Made by modules found by name: they know results, which do not need them."""
        return import_module("studies.cards").report_of(self)

    def plot(self, name: str = "") -> Any:
        """A figure of its report, for Matplotlib; name: which one, default: the first."""
        return self.report().plot(name)

    def _repr_html_(self) -> str:
        return str(import_module("studies.cards").card(self))


class Summary(Labelled, command="summary"):
    """What a command tells, of results without a document of their own."""

    title: str = told("of the report")
    result: list[str] = told("in sentences")
    is_good: bool = told("whether the answer is what one asks for")
    files: list[str] = told("what was written, in lines")


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def in_folder(result: R, folder: Path | None, page: Path | None = None) -> R:
    """The same result, which knows where its files and the page of its report are."""
    object.__setattr__(result, "folder", folder)
    object.__setattr__(result, "report_page", page)
    return result
