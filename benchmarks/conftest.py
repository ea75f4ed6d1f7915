"""Prints what a benchmark measured besides its time."""


def pytest_terminal_summary(terminalreporter, config):
    session = getattr(config, "_benchmarksession", None)
    rows = [
        (benchmark.name, name, value)
        for benchmark in (session.benchmarks if session else [])
        for name, value in benchmark.extra_info.items()
    ]
    if rows:
        terminalreporter.section("figures")
        for benchmark, name, value in rows:
            terminalreporter.write_line(f"{benchmark}: {name} {value:.4g}")
    tables = getattr(config, "ray_caster_tables", None)
    if tables:
        terminalreporter.section("ray casters")
        terminalreporter.write(tables)
