"""The page of :mod:`studies.fleet`: what was lost, what a record takes, and what that is for many machines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from studies import pages
from studies.fleet_day import A_DAY, AXES, EACH_NOTICE

FLEETS = (30, 3_000, 100_000)
MONTH = 30  # days
EACH_RAPID = 3  # records: a window, a set, and a prediction or at times a notice
PEAK = 3.0  # how much more than on average a fleet tells while it works
Figures = Mapping[str, Any]


def page(run: Mapping[str, str], figures: Figures) -> str:
    """Return the page."""
    lines = pages.write_head("Many machines: what a fleet takes, and what a failure costs", "fleet", run)
    lines += [
        *_describe_day(figures),
        *_describe_sizes(figures),
        *_describe_fleets(figures),
        *_describe_open_points(),
        *_describe_kills(figures),
        *_describe_network_cut(figures),
    ]
    return "\n".join(lines)


def _format_bytes(count: float) -> str:
    """Return a size in words."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _describe_when(part: Figures) -> str:
    return f"Measured on {part['date']}, commit {part['commit']}."


def _describe_day_rate() -> int:
    return A_DAY * len(AXES) * EACH_RAPID


def _describe_day(figures: Figures) -> list[str]:
    wire = figures["killed"]["wire"]
    rows = [[f"`{kind}`", f"{each['records']}", f"{each['bytes']:.0f}"] for kind, each in wire.items()]
    return [
        "## What a machine records in a day",
        "",
        *pages.wrap_paragraph(
            f"""All figures below are for a machine with {len(AXES)} axes that makes a rapid (G0) a minute with each of
            them, around the clock: {A_DAY * len(AXES)} rapids in a day. Of each rapid there are {EACH_RAPID} records:
            what was found in its window, the parameter set that follows from it, and how well it was predicted; of one
            rapid in {EACH_NOTICE} a notice in its place. That is {_describe_day_rate():,} records in a day, and a busy
            machine. A
            machine that makes a tenth of the rapids has a tenth of all that follows."""
        ),
        *pages.write_table(["kind", "records (of the day that was sent)", "bytes of one, on the wire"], rows),
        "",
    ]


def _describe_sizes(figures: Figures) -> list[str]:
    each = figures["killed"]["a_record"]
    places = {
        "the machine's own history (kept anyway)": "history",
        "the machine's outbox, until it is sent": "outbox",
        "on the wire, and in JetStream until it is collected": "wire",
        "in PostgreSQL: the rows": "table",
        "in PostgreSQL: key and indexes": "indexes",
    }
    rows = [
        [
            place,
            f"{each[key]:.0f}",
            _format_bytes(each[key] * _describe_day_rate()),
            _format_bytes(each[key] * _describe_day_rate() * MONTH),
        ]
        for place, key in places.items()
    ]
    return [
        "## What it takes",
        "",
        *pages.write_table(["where", "bytes a record", "a machine and day", f"a machine and {MONTH} days"], rows),
        "",
        *pages.wrap_paragraph(
            """A recorded window that is sent whole is a file besides, of 5 to 100 kB, by how long a rapid and how fast
            a drive is sampled. With `windows = "refused"` that is one rapid in some hundred."""
        ),
    ]


def _describe_fleets(figures: Figures) -> list[str]:
    calm, each = figures["calm"], figures["killed"]["a_record"]
    used_us = calm["processor_us"]
    names = ["", *(f"{count:,} machines" for count in FLEETS)]

    def row(name: str, value: Any) -> list[str]:
        return [name, *(value(count) for count in FLEETS)]

    def a_second(count: int) -> float:
        return count * _describe_day_rate() / 86_400

    def cores(part: str) -> Any:
        return lambda count: f"{PEAK * a_second(count) * used_us[part] / 1e6:.2g}"

    rows = [
        row("records a second, on average", lambda count: f"{float(f'{a_second(count):.3g}'):,g}"),
        row("on the wire", lambda count: f"{_format_bytes(a_second(count) * each['wire'])}/s"),
        row(
            "in JetStream, when a day is not collected",
            lambda count: _format_bytes(count * _describe_day_rate() * each["wire"]),
        ),
        row(
            f"PostgreSQL in {MONTH} days",
            lambda count: _format_bytes(count * _describe_day_rate() * MONTH * each["database"]),
        ),
        row(
            "of it key and indexes", lambda count: _format_bytes(count * _describe_day_rate() * MONTH * each["indexes"])
        ),
        row(f"cores for collectors, {PEAK:.0f} times the average", cores("collectors")),
        row("cores for PostgreSQL, the same", cores("PostgreSQL")),
        row("cores for nats-server, the same", cores("nats-server")),
    ]
    reported = ", ".join(f"{name} {value:.0f}" for name, value in used_us.items())
    return [
        "## What a fleet needs",
        "",
        *pages.wrap_paragraph(
            f"""{_describe_when(calm)}
            Processor time of a record, in µs, with {calm["machines"]} machines and {calm["records"]} records
            through two collectors, starting all of them included: {reported}. That of the uplinks is spent on the
            machines,
            each its own. It is the processor's time, not the clock's, so that other work on the same computer counts
            little."""
        ),
        *pages.write_table(names, rows),
        "",
    ]


TODO = (
    """**30 machines:** one small server for nats-server, PostgreSQL and one `fdhil fleet collect`; the database is
    backed up as any other. Nothing else.""",
    """**3,000 machines:** three nats-servers with `[stream] replicas = 3`; PostgreSQL on a computer of its own, on
    SSDs, as what comes goes to random places of the newest month's key; as many collectors as the table says
    and one more, on any computers that share the folder of windows. Months are partitions: one that is not
    needed any more is dropped as a whole, at once, and a question about a month reads that month alone. Or tell
    less, and keep fewer months.""",
    """**100,000 machines:** more than one database. Divide the machines by works or by type: each part has its own
    stream, collectors and database as above, and is a fleet of its own; PostgreSQL's foreign tables put their
    views together. Nothing on a machine depends on there being one. This was not tried.""",
)


def _describe_open_points() -> list[str]:
    return ["## What to do", "", *(line for each in TODO for line in pages.wrap_paragraph(f"- {each}"))]


def _describe_kills(figures: Figures) -> list[str]:
    killed = figures["killed"]
    kills = pages.join_words([f"{name} {count} times" for name, count in sorted(killed["kills"].items())])
    return [
        "## What kills cost",
        "",
        *pages.wrap_paragraph(
            f"""{_describe_when(killed)}
            {killed["machines"]} machines sent {killed["records"]:,} records through a nats-server and two
            collectors into PostgreSQL, while all of these were killed with SIGKILL at random, one or two at once:
            {sum(killed["kills"].values())} kills ({kills}; the uplinks run as processes of many). Each record in the
            database was then compared with what the machines had recorded: **{killed["lost"]} lost,
            {killed["doubled"]} doubled, {killed["out_of_order"]} out of the order** in which its machine recorded them;
            {killed["refused"]} refused, {killed["miscounted"]} machines with a wrong count of missing ones. It took
            {killed["took_s"] / 60:.0f} minutes on a computer that was busy with other work."""
        ),
    ]


def _describe_network_cut(figures: Figures) -> list[str]:
    cut = figures["cut"]
    pace = "" if cut["cut_s"] >= 3600 else "the hour is compressed, the cut is not; "
    return [
        "## What a cut network costs",
        "",
        *pages.wrap_paragraph(
            f"""{_describe_when(cut)}
            A network that drops all and tells nobody, for {cut["cut_s"]:.0f} s, while {cut["machines"]} machines
            record an hour of work ({cut["records"]} records; {pace}a router that has forgotten the connections when
            it is back). {cut["through"]} records came through meanwhile. When it was
            back the first came after {cut["first_s"]:.0f} s, which is how long an uplink waits that tried in vain, and
            all were there after {cut["all_s"]:.0f} s: {cut["lost"]} lost, {cut["out_of_order"]} out of order."""
        ),
    ]
