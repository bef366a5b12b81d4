"""Results of runs as pandas tables: means, differences between methods, the hardest images.

    python examples/01_photos_to_table.py                        trains two methods on a small capture
    python examples/05_results_with_pandas.py                    reads its runs
    python examples/05_results_with_pandas.py --runs runs        reads a folder that 'aw bench' wrote

Every number comes from the metrics.json of a run. `docs/metrics.md` says what each metric is.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pandas as pd

from ambiguous_wild import read_runs
from ambiguous_wild.core import AwError
from ambiguous_wild.report.comparison import tidy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("example_photos_to_table/runs"))
    parser.add_argument("-o", "--output", type=Path, default=Path("example_results"))
    wanted = parser.parse_args()

    # One row for each method, scene, seed, image and metric. A missing value is NaN, and `reason` says why.
    results = tidy(read_runs(wanted.runs))
    print(results.head(), "\n")

    # Numbers of an image have its name; those of a whole run (cost, masks) have an empty one.
    images = results[results["image"] != ""]
    whole = results[results["image"] == ""]

    # Mean over images, then over seeds, then over scenes. skipna=False: a mean with a gap is no mean.
    means = images
    for level in (["method", "metric", "scene", "seed"], ["method", "metric", "scene"], ["method", "metric"]):
        means = means.groupby(level, as_index=False)["value"].agg(lambda v: v.mean(skipna=False))
    print(means.pivot(index="method", columns="metric", values="value").round(3), "\n")

    # The cost of each method: seconds, Gaussians and size, averaged over its runs.
    cost = whole[whole["metric"].isin(["train_s", "gaussians", "model_mb", "fps"])]
    print(cost.pivot_table(index="method", columns="metric", values="value").round(1), "\n")

    # Differences image by image, on the same scene with the same seed: these tell two methods apart
    # better than two means do.
    psnr = images[images["metric"] == "psnr"].pivot(
        index=["scene", "seed", "image"], columns="method", values="value"
    )
    first, *others = psnr.columns
    differences = psnr[others].sub(psnr[first], axis=0).add_suffix(f" - {first}")
    print(differences.describe().loc[["mean", "min", "max"]].round(2), "\n")

    # The images that are hardest for every method.
    print(psnr.mean(axis=1).sort_values().head(3).rename("mean PSNR").round(2))

    path = wanted.output / "results.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(results).to_csv(path, index=False)
    print(f"wrote {path}")


if __name__ == "__main__":
    try:
        main()
    except AwError as error:
        sys.exit(f"error: {error}")
