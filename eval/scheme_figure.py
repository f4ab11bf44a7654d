"""The figure of schemes: what comes back of a map for each way to hide it."""

from __future__ import annotations

import io
from collections.abc import Sequence

from eval.figures import RC, Drawing
from eval.result_tables import distinct, fractions_of, pool_seed
from eval.scheme_table import SHARE, attacker_of
from eval.scoring import Row

#: Name of the figure.
FIGURE = "schemes"


def draw_schemes(rows: Sequence[Row]) -> list[Drawing]:
    """Draw the share that comes back of each scheme, for each attacker and the largest and smallest fraction; nothing
    for runs with uniform lines only."""
    import matplotlib
    from matplotlib.figure import Figure

    schemes, fractions = distinct(rows, "scheme"), fractions_of(rows)
    if len(schemes) < 2:
        return []
    attackers = list(dict.fromkeys(attacker_of(row) for row in rows))
    shown = list(dict.fromkeys((fractions[0], fractions[-1])))
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(7.5, 0.32 * len(schemes) + 1.4), layout="constrained")
        panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for axes, fraction in zip(panels, shown, strict=True):
            for number, attacker in enumerate(attackers):
                places = []
                for height, scheme in enumerate(schemes):
                    own = [
                        row
                        for row in rows
                        if (row["scheme"], row["fraction"], attacker_of(row)) == (scheme, fraction, attacker)
                    ]
                    values = [
                        value for seed in distinct(own, "seed") if (value := pool_seed(own, SHARE, seed)) is not None
                    ]
                    if values:
                        places.append((sum(values) / len(values), height))
                if places:
                    across, up = zip(*places, strict=True)
                    marker = "os^Dvx"[number % 6]
                    axes.plot(across, up, marker, color=f"C{number}", label=attacker, markersize=5, clip_on=False)
            axes.set(xlim=(0, 1), title=f"{100 * fraction:g} % of the points", xlabel="within 1 spacing")
        panels[0].set(ylim=(len(schemes) - 0.5, -0.5))
        panels[0].set_yticks(range(len(schemes)), schemes)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
    caption = (
        "Share of the published points that come back within 1 spacing, for each way to hide the map and each attacker"
    )
    return [Drawing(f"{FIGURE}.svg", caption, file.getvalue())]
