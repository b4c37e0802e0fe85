"""How often a term is described rightly: truths that no catalogue has, on hidden rigs.

    PYTHONPATH=tests python scripts/term_reach.py --seeds 3,4 --program short [--only NAME,NAME]

Each case recalibrates, asks all questions of the block that has most left, fits the best in the
plant, and says which place and driver come first, and which name of the catalogue takes the term's
place. The catalogue is not searched: this measures the terms alone. One line of JSON a case, then
the table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from hidden.uncatalogued import UNCATALOGUED, Uncatalogued

from pamctl.diagnose import Record
from pamctl.diagnose.fitting.evidence import prepare_evidence, with_modelled_pressure
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.name import Naming
from pamctl.diagnose.naming.search import closed_share
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.terms.by_name import name_instead
from pamctl.diagnose.terms.trials import choose_simplest, find_terms
from pamctl.plant.model import PlantSettings


def examine(case: Uncatalogued, program: str, seed: int) -> dict[str, object]:
    """Return how one case went."""
    parts = case.record(program, seed)
    train, held_out = ([Record(name=r.name, **r.columns()) for r in part] for part in parts)
    plain = prepare_evidence(train, held_out, PlantSettings())
    alone = recalibrate(plain.select_blocks({"pressure"}))
    driven = with_modelled_pressure(
        plain, train, held_out, alone.fit_of("pressure").settings, trusted=alone.is_complete
    )
    base = recalibrate(driven, alone.fits)
    block = max(base.evidence.blocks, key=base.ratio)
    began = time.process_time()
    ranking, trials = find_terms(base, block)
    spent_s = time.process_time() - began
    found: dict[str, object] = {
        "case": case.name, "seed": seed, "block": block, "left": round(base.ratio(block), 2),
        "asked": ranking.asked, "by_chance": round(ranking.by_chance, 3),
        "cpu_s": round(spent_s, 1),
    }  # fmt: skip
    if not trials or base.is_explained(block):
        return found | {"first": False, "three": False, "closed": 0.0, "silent": True}
    chosen = choose_simplest(trials)
    order = [chosen, *(t for t in trials if t is not chosen)]
    places = list(dict.fromkeys((t.question.location.name, t.question.driver) for t in order))
    right = [_is_right(case, place) for place in places[:3]]
    nothing = Naming(Verdict.NONE_KNOWN, base, base, (), (), ())
    named = name_instead(nothing, base, chosen, trials, block)
    names = named.model.names if named else ()
    values = {n.split(".")[1]: round(v, 6) for n, v in chosen.model.effect_values.items()}
    return found | {
        "first": right[0], "three": any(right),
        "closed": round(closed_share(base, chosen.model, block), 3),
        "said": [*chosen.question.key, values],
        "named": {**named.model.effect_values} if named else {},
        "named_rightly": names == (case.called,),
        "ratios": [round(t.model.ratio(block), 2) for t in order[:3]],
        "next": [t.question.key for t in order[1:3]],
    }  # fmt: skip


def _is_right(case: Uncatalogued, place: tuple[str, str]) -> bool:
    return any(p == place[0] and d in ("", place[1]) for p, d in case.right)


def main() -> None:
    """Examine the cases, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="3,4,5")
    parser.add_argument("--program", default="short")
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    only = {name for name in given.only.split(",") if name}
    results = []
    for seed in map(int, given.seeds.split(",")):
        for case in UNCATALOGUED:
            if not only or case.name in only:
                results.append(examine(case, given.program, seed))
                print(json.dumps(results[-1]), flush=True)
    count = len(results)
    named = [r for r in results if r.get("named")]
    print(f"named {len(named)}, rightly {sum(bool(r['named_rightly']) for r in named)}")
    print(f"place and driver first {sum(bool(r['first']) for r in results)} of {count}, among "
          f"three {sum(bool(r['three']) for r in results)} of {count}")  # fmt: skip


if __name__ == "__main__":
    main()
