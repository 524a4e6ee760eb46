"""Dataset ids: how they are spelled, checked, and mapped to folders.

``walker/cudc-v0`` is seed 1, ``walker/cudc-seed2-v0`` the next, ``walker/cudc-smoke-v0`` the same at a profile for trying;
``walker/walk/cudc-v0`` is the first relabelled for a task.
Names are for people: code reads the manifest. The grammar is stricter than Minari's, since one malformed folder below the dataset
root makes Minari unable to list any dataset at all.
"""

from __future__ import annotations

import os
import re
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

from cudc_bench.errors import UsageError
from cudc_bench.files import LeftOut, check_folder, check_path, environment, walk
from cudc_bench.settings.profiles import PROFILES

_ID = re.compile(
    r"(?P<namespace>[a-z0-9_]{2,64}(?:/[a-z0-9_]{2,64}){0,3})/(?P<name>[a-z0-9](?:[a-z0-9_-]{0,98}[a-z0-9])?)-v(?P<version>0|[1-9]\d{0,5})"
)
_RULE = "lower-case letters, digits, '_' and '-', no folder called 'data', as in 'walker/cudc-v0' or 'walker/walk/cudc-seed2-v0'"

_DEEPEST = 5  # folders below the root that the longest id has


@dataclass(frozen=True)
class DatasetId:
    """A checked dataset id.

    Attributes:
        namespace: one or more path components, such as ``"walker"`` or ``"walker/walk"``.
        name: the name without its version, such as ``"cudc-seed2"``.
        version: the number behind ``-v``.
    """

    namespace: str
    name: str
    version: int

    def __str__(self) -> str:
        return f"{self.namespace}/{self.name}-v{self.version}"

    def for_task(self, task: str) -> DatasetId:
        """The id of this dataset relabelled for a task: ``walker/cudc-v0`` becomes ``walker/walk/cudc-v0``.

        Raises:
            UsageError: the namespace has no room for the task.
        """
        return parse_id(f"{self.namespace}/{task}/{self.name}-v{self.version}")


def parse_id(text: str) -> DatasetId:
    """Check an id before it can become a path.

    Raises:
        UsageError: the id is not of the form ``namespace/name-vN``.
    """
    match = _ID.fullmatch(text)
    # Minari takes every folder that holds one called "data" for a dataset: such a namespace would hide or break all others.
    if match is None or not text.isascii() or "data" in match["namespace"].split("/"):
        raise UsageError(f"'{text}' is not a dataset id; allowed: namespace/name-vN in {_RULE}.")
    return DatasetId(match["namespace"], match["name"], int(match["version"]))


def domain_namespace(domain: str) -> str:
    """A domain's part of dataset ids: ``walker``, and ``dm_control/cheetah_run`` for the domain ``dm_control/cheetah-run``."""
    return domain.replace("-", "_").lower()


def domain_slug(domain: str) -> str:
    """A domain's part of names that are one word: ``walker``, and ``dm_control.cheetah-run`` for ``dm_control/cheetah-run``."""
    return domain.replace("/", ".")


def default_id(domain: str, method: str, seed: int, profile: str) -> DatasetId:
    """The id under which ``collect`` stores a dataset unless told otherwise.

    Seed 1 has the plain name, as have the profiles ``paper`` and ``cpu``, which ``auto`` chooses from; others are named, as in
    ``walker/cudc-smoke-seed2-v0``, so that a first try never stands in the way of real data.
    """
    known = PROFILES.get(profile)
    suffix = (f"-{profile}" if known is not None and known.in_ids else "") + ("" if seed == 1 else f"-seed{seed}")
    try:
        return parse_id(f"{domain_namespace(domain)}/{method}{suffix}-v0")
    except UsageError:
        raise UsageError(f"the method '{method}' cannot name a dataset; allowed: lower-case letters, digits, '_' and '-'.") from None


def datasets_root() -> Path:
    """Minari's dataset root: ``MINARI_DATASETS_PATH`` or ``~/.minari/datasets``, read at each call as Minari does.

    Raises:
        UsageError: it is no path.
    """
    root = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    return check_path(root, "the dataset root")


def rooted_at(root: Path | None) -> AbstractContextManager[None]:
    """Within this context another folder is the dataset root, for this process and those that it starts; with None the same as before."""
    return nullcontext() if root is None else environment("MINARI_DATASETS_PATH", str(root))


def dataset_path(dataset_id: DatasetId | str, root: Path | None = None) -> Path:
    """The folder of a dataset (which holds ``data/``), whether or not it exists."""
    checked = dataset_id if isinstance(dataset_id, DatasetId) else parse_id(dataset_id)
    return (root or datasets_root()).joinpath(*str(checked).split("/"))


def stored_ids(root: Path | None = None, left_out: LeftOut | None = None) -> list[DatasetId]:
    """The ids of all complete datasets below the root in the order of their names, ours or not, whether they can be read or not.

    Args:
        root: Minari's; links in it are followed, as Minari does.
        left_out: told of each folder that cannot be read.
    """
    root = check_folder(root or datasets_root(), "the dataset root", writable=False)
    found = []
    for place, folders, names in walk(root, left_out, once=False):
        if len(place.relative_to(root).parts) > _DEEPEST:
            folders.clear()
        if place.name == "data" and "metadata.json" in names:
            # What has no id cannot be asked for; what begins with a dot is still being built.
            with suppress(UsageError):
                found.append(parse_id(place.parent.relative_to(root).as_posix()))
    return sorted(found, key=lambda one: Path(str(one)))
