"""Set-up of a process of the loop: real-time measures, then clock, bus and service."""

from functools import partial

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.bus.zenoh_session import receive_in_one_thread
from lowfc.adapters.process.clock import Clock, HostClock, SimulatedClock
from lowfc.adapters.process.realtime import NOTHING, Granted, set_up, use_huge_pages
from lowfc.adapters.process.service import Service
from lowfc.adapters.process.supervision import Supervisor
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import Role


def clock_of(config: Configuration) -> Clock:
    """Make the run's clock: the host's, or a simulated one in lockstep."""
    return SimulatedClock() if config.lockstep else HostClock()


def fifo_priority(config: Configuration) -> int:
    """Priority of SCHED_FIFO, 0 for none; in lockstep the processes never idle, and would starve all other programs."""
    return 0 if config.lockstep else config.realtime.priority


def prepare(config: Configuration, role: str, cpus: list[int]) -> Granted:
    """Set this process up for the loop, before its first zenoh session, whose threads inherit the scheduling.

    Camera, controller and mirror have the same priority: if mirror and controller share a processor, the controller
    yields after its put, so that a command is applied before the controller publishes its step.
    """
    if role != Role.CAMERA:  # a simulated camera computes while messages arrive
        receive_in_one_thread()
    realtime = config.realtime
    return set_up(
        fifo_priority(config) or None,
        set(cpus) or None,
        lock_memory=realtime.lock_memory,
        disable_cpu_idle=realtime.disable_cpu_idle,
    )


def prepare_ready(config: Configuration) -> Granted:
    """Request huge pages, once the process is ready."""
    return use_huge_pages() if config.realtime.lock_memory else NOTHING


def join(config: Configuration, run_id: str, role: str, cpus: list[int]) -> Service:
    """Set this process up for the loop and join a run."""
    granted = prepare(config, role, cpus)
    run = open_run(run_id, (config.mirror.name,), network=config.network)
    clock = clock_of(config)
    bus = ZenohBus(run.links, role, clock)
    return Service(role, run_id, clock, bus, granted=granted, at_ready=partial(prepare_ready, config), announces=True)


def join_beside(config: Configuration, service: Service, role: str) -> Service:
    """Join the run again, in another role of this process; a direct link between both roles is a function call.

    The service manager is notified by `service` only.
    """
    assert isinstance(service.bus, ZenohBus)  # noqa: S101  # as `join` made it
    links = open_run(service.run_id, (config.mirror.name,), network=config.network).links
    bus = ZenohBus(links, role, service.clock, beside=service.bus)
    return Service(role, service.run_id, service.clock, bus, announces=True, supervisor=Supervisor({}))
