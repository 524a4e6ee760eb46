"""Thresholds that pilots measured: those that come with the package, and a user's own in a file beside the results."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from cudc_bench.artefacts.manifest import Pilot
from cudc_bench.errors import RunError
from cudc_bench.execution.locks import locked
from cudc_bench.files import check_file, read_limited, unwritable, write_atomically
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import as_dict, config_hash

VARIABLE = "CUDC_BENCH_THRESHOLDS"
OURS = Path(__file__).parent.with_name("thresholds.json")


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: Literal[1] = 1
    thresholds: list[Pilot]


def thresholds_path() -> Path:
    """The user's file: ``thresholds.json`` in the current folder, or what ``CUDC_BENCH_THRESHOLDS`` names.

    Raises:
        UsageError: it cannot be a file.
    """
    return check_file(os.environ.get(VARIABLE) or "thresholds.json", "the file of thresholds", writable=False)


def read_thresholds(path: Path) -> list[Pilot]:
    """The thresholds of a file; none if it does not exist.

    Raises:
        RunError: it cannot be read, or is not such a file.
    """
    try:
        return _File.model_validate_json(read_limited(path)).thresholds
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RunError(f"the thresholds in {path} cannot be read: {error.strerror}.") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise RunError(f"the thresholds in {path} are damaged: {where}: {first['msg']}; mend or remove it.") from None


def write_thresholds(path: Path, found: Iterable[Pilot]) -> None:
    """Put thresholds into a file, in the place of those for the same settings.

    Raises:
        RunError: the file is damaged or cannot be written.
    """
    # Several pilots may end at the same time, and none may lose what another has just added.
    with locked(path.with_name(f".{path.name}.lock"), str(path), patience=60.0):
        kept = {pilot.key: pilot for pilot in read_thresholds(path)} | {pilot.key: pilot for pilot in found}
        ordered = sorted(kept.values(), key=lambda pilot: (pilot.domain, pilot.method, pilot.profile, pilot.key))
        content = json.dumps(_File(thresholds=ordered).model_dump(mode="json"), indent=1, ensure_ascii=False)
        try:
            write_atomically(path, f"{content}\n")
        except OSError as error:
            raise unwritable(path, error) from None


def settings_key(kind: Any, method: str, domain: str, loop: CollectConfig, config: Any) -> str:
    """The hash of all settings that a pilot's threshold depends on.

    The length of the run is left out, so that a short run can use the threshold of a long one, and so are the threshold itself and what
    has no effect while k stays (``ignored_by_pilot``).
    """
    ignored = {"steps", "measure_every", kind.measured_by_pilot(config), *kind.ignored_by_pilot}
    values = {name: value for name, value in as_dict(loop, config).items() if name not in ignored}
    return config_hash({"method": method, "domain": domain, **values})


def find_threshold(kind: Any, method: str, domain: str, loop: CollectConfig, config: Any) -> Pilot | None:
    """The pilot for these settings: the user's own, or else ours.

    Raises:
        RunError: the user's file is damaged.
    """
    key = settings_key(kind, method, domain, loop, config)
    return next((pilot for path in (thresholds_path(), OURS) for pilot in read_thresholds(path) if pilot.key == key), None)
