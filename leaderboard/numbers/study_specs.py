"""The paper's studies of CUDC's parts by their methods' names.

Names that exist for these studies alone (those of ``collectors/variants.py``) stay out of the main tables, which would otherwise be
unreadable and would ask for every one of them in every domain.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..methods import BASELINES


@dataclass(frozen=True)
class StudySpec:
    """One study of methods on a domain.

    Attributes:
        name: in files' names.
        title: what it compares.
        about: one sentence for its caption.
        methods: in the order of its tables, by the names that it uses for them.
        relative: whether scores are also divided by CUDC's.
        bounds: the k_max of each method, if the study sweeps it.
    """

    name: str
    title: str
    about: str
    methods: tuple[str, ...]
    relative: bool = False
    bounds: tuple[int, ...] = ()

    @property
    def own(self) -> tuple[str, ...]:
        """The methods with which it begins: those that no main table has."""
        return tuple(method for method in self.methods if method not in BASELINES)


VARIANTS = StudySpec(
    "variants",
    "From ICM and APT to CUDC, step by step",
    "The paper's Table 2: what each proposed component adds.",
    ("icm", "cudc-vary-icm", "apt", "cudc-vary-apt", "cudc-reward", "cudc-reach", "cudc"),
)
SCHEDULE = StudySpec(
    "schedule",
    "Ways to choose k",
    "The paper's comparison of CUDC's k, which adapts, with a k that is drawn for each update.",
    ("cudc-uniform-k", "cudc-normal-k", "cudc"),
)
ABLATION = StudySpec(
    "ablation",
    "CUDC without one of its parts",
    "The paper's Table 3: what is left of CUDC's score without one of its components.",
    ("cudc-no-entropy", "cudc-no-pe", "cudc-no-regularize", "cudc-no-vary", "cudc-no-reach", "cudc-no-inverse", "cudc"),
    relative=True,
)
K_BOUND = StudySpec(
    "k-bound",
    "The upper bound of k",
    "The paper's sweep of the largest k from 3 to 8; CUDC's own is 6.",
    ("cudc-kmax3", "cudc-kmax4", "cudc-kmax5", "cudc-kmax6", "cudc-kmax7", "cudc-kmax8"),
    bounds=(3, 4, 5, 6, 7, 8),
)
CONTROLS = StudySpec(
    "controls",
    "Controls that the paper lacks",
    "Whether a longer bootstrap alone, one setting for all domains, or another reading of the equations gives what CUDC gives.",
    ("apt", "apt-k6", "apt-ksched", "cudc", "cudc-one-setting", "cudc-literal", "cudc-kmix"),
)
READINGS = StudySpec(
    "readings",
    "What CUDC's forward model predicts",
    "Three readings of the target of the paper's forward loss: z' with its gradient, without it, or a slow copy's.",
    ("cudc-live", "cudc-stopgrad", "cudc-momentum"),
)
SPECS = (VARIANTS, SCHEDULE, ABLATION, K_BOUND, CONTROLS, READINGS)
STUDY_METHODS = frozenset(method for spec in SPECS for method in spec.own)
