"""``cudc-bench collect``."""

from __future__ import annotations

from cudc_bench.errors import UsageError
from cudc_bench.options import (
    DatasetIdOption,
    DeviceOption,
    DomainOption,
    MethodOption,
    OverwriteOption,
    ProfileOption,
    SeedsOption,
    SetOption,
    WorkersOption,
    parse_names,
    parse_seeds,
)


def collect(
    method: MethodOption = "cudc",
    domain: DomainOption = "walker",
    seeds: SeedsOption = "1",
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    dataset_id: DatasetIdOption = None,
    overwrite: OverwriteOption = False,
    device: DeviceOption = "auto",
    workers: WorkersOption = None,
) -> None:
    """Explore a domain without rewards and write Minari datasets."""
    from cudc_bench import plugins
    from cudc_bench.config import parse_settings
    from cudc_bench.progress import say

    from .api import collect as run

    methods = [plugins.check_name("collectors", name) for name in parse_names(method)]
    if not methods:
        raise UsageError("--method is empty; see cudc-bench list.")
    if dataset_id is not None and len(methods) > 1:
        raise UsageError("--dataset-id names one dataset, but there are several methods; leave it out.")
    ids: list[str] = []
    # All input is checked before any work starts, the last method's before the first one's.
    for check_only in (True, False):
        ids = [
            one
            for name in methods
            for one in run(
                name, domain, parse_seeds(seeds), profile=profile, settings=parse_settings(settings or []), dataset_id=dataset_id,
                overwrite=overwrite, device=device, workers=workers, check_only=check_only,
            )
        ]  # fmt: skip
    for one in ids:
        print(one)
    say(f"next: cudc-bench relabel {ids[0]}, or in Python: minari.load_dataset('{ids[0]}')")
