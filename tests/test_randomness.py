"""Every random number follows from a seed and a purpose."""

import re
from itertools import product

import numpy as np

from study.randomness import rng
from tests.support.processes import ROOT

PINNED = [2251191395, 3058298961, 3676464713]


def test_a_seed_and_a_purpose_give_the_same_numbers_every_time() -> None:
    assert rng(3, "town").random() == rng(3, "town").random()
    assert rng(0, "pinned").integers(2**32, size=3).tolist() == PINNED


def test_seeds_purposes_and_kinds_of_generators_differ() -> None:
    kinds = np.random.PCG64, np.random.SFC64
    draws = {rng(seed, purpose, kind).random() for seed, purpose, kind in product(range(20), ("a", "b"), kinds)}
    assert len(draws) == 80


def test_nothing_else_in_the_program_makes_a_generator() -> None:
    makers = re.compile(r"default_rng|random\.Generator\(|RandomState|random\.seed|torch\.manual_seed")
    sources = {path.relative_to(ROOT).as_posix(): path.read_text() for path in (ROOT / "study").rglob("*.py")}
    assert [name for name, text in sources.items() if makers.search(text)] == ["study/randomness.py"]
