"""Command line of the simulated mirror."""

from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from lowfc.device import run_mirror
from lowfc.device.plugins import opened
from sim_dm.driver import SimulatedMirror

app = new_app("The simulated deformable mirror.\n\nExample: sim-dm --run bench --config lowfc.toml")


@app.command()
def mirror(run: RunId = DEFAULT_RUN, config: ConfigFile = None) -> None:
    """Apply the commands of a run within the mirror's own limits, and publish its shape.

    Example: sim-dm --run bench
    """
    settings = configuration(config)
    run_mirror(opened("mirror", "sim", settings, (), SimulatedMirror), settings, run)


def main() -> None:
    """Entry point."""
    run_app(app)


if __name__ == "__main__":
    main()
