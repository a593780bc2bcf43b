"""Command line of the simulated mirror."""

from contextlib import closing

from lowfc.adapters.bus.run import mirror_role
from lowfc.adapters.process.join import join
from lowfc.adapters.process.terminal import DEFAULT_RUN, ConfigFile, RunId, configuration, new_app, run_app
from sim_dm.process import MirrorProcess

app = new_app("The simulated deformable mirror.\n\nExample: sim-dm --run bench --config lowfc.toml")


@app.command()
def mirror(run: RunId = DEFAULT_RUN, config: ConfigFile = None) -> None:
    """Follow the commands of a run within the mirror's own limits, and publish where it is.

    Example: sim-dm --run bench
    """
    settings = configuration(config)
    service = join(settings, run, mirror_role(settings.mirror.name), settings.realtime.mirror_cpus)
    process = MirrorProcess(settings, service)
    service.catch_signals()
    with closing(service.bus):  # a callback on zenoh's threads must not outlive the interpreter
        process.run()


def main() -> None:
    """Entry point."""
    run_app(app)


if __name__ == "__main__":
    main()
