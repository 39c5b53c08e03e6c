"""Draw docs/first_picture.png: what is left of a fast square with and without control."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import studies


def main() -> None:
    """Run the default study twice and plot the bending."""
    studies.configure()
    fast = studies.Study()
    runs = {
        "without control": studies.simulate(fast.change(control__gain_factor=0.0)),
        "with control": studies.simulate(fast),
    }
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(7, 5), layout="constrained")
    for (label, run), color in zip(runs.items(), ("0.6", "C0"), strict=True):
        time = 1e3 * (run.data.time - run.data.command_end)
        for axis, deflection in zip(axes, 1e6 * run.data.chord_deflection.values.T, strict=True):
            axis.plot(time, deflection, color=color, lw=1.2, label=label)
    windows = runs["with control"].run.case.windows
    begin = 1e3 * float(windows.residual_delay)
    end = begin + 1e3 * float(windows.residual_length)
    for i, axis in enumerate(axes):
        axis.axvspan(begin, end, color="0.93", zorder=0)
        axis.axvline(0, color="0.3", ls="--", lw=1)
        axis.set(ylabel=f"link {i + 1} [µm]", xlim=(-20, end), ylim=(-60, 60))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    figure.suptitle(
        "Bending at mid-span; the motion ends at 0", x=0.1, ha="left", fontsize="medium"
    )
    axes[-1].set_xlabel("time [ms]")
    figure.savefig(Path(__file__).with_name("first_picture.png"), dpi=110)


if __name__ == "__main__":
    main()
