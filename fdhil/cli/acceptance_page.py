"""Page of the acceptance report: verdict, commissioning, parameters, circular test, path, signatures."""

from collections.abc import Mapping
from typing import Any

from fdhil.cli.acceptance_findings import NO_LIMIT, AxisProof, Findings
from fdhil.cli.doctor.latency import format_latency
from fdhil.report import (
    INTERVAL_MEANING,
    LATEST_HEAD,
    Page,
    Section,
    Table,
    build_correction_page,
    build_latest_rows,
    draw_polar,
    format_minute,
)

CIRCLE_ROWS = (
    "G, counter-clockwise (um)", "G, clockwise (um)", "G(b), both runs (um)", "H, between the runs (um)",
    "F, farthest outside (um)", "F, farthest inside (um)",
)  # fmt: skip
PROOF_ROWS = (
    "vendor, product, revision", "serial number", "offset read back", "motion by an offset of 10 um",
    "following-error window", "stops without heartbeat", "commissioned (UTC)", "record, digest", "open",
)  # fmt: skip
SIGNATURES = ("tested by", "received by")
LINE = "_" * 28


def build_acceptance_page(found: Findings, document: Mapping[str, Any]) -> Page:
    """Return the page; ``document`` is the JSON content with its hash."""
    state = "accepted" if not found.open_points else f"{len(found.open_points)} points open"
    sections = [_build_machine_section(found), _build_proof_section(found), _build_parameter_section(found)]
    if found.plane is not None:
        sections.append(_build_circular_section(found))
    sections.append(_build_operation_section(found))
    if found.path is not None and found.options.program is not None:
        page = build_correction_page(found.options.program.name, "", found.path)
        sections += [Section(f"Program {found.options.program.name}: {s.title}", s.text, s.tables, s.figures)
                     for s in page.sections]  # fmt: skip
    commissioned = sum(not proof.against for proof in found.proofs.values())
    tiles = [("verdict", state), ("drives commissioned", f"{commissioned} of {len(found.proofs)}")]
    tiles += [(f"circle, {label}, G(b)", f"{circle.both_um:.1f} um") for label, circle in found.circles.items()]
    return Page(
        f"Acceptance of {found.machine.machine.name}",
        "Commissioning, parameters and accuracy of its drives. Nothing was sent for this report.",
        tiles,
        [*sections, _build_signature_section(found, document)],
    )


def _build_machine_section(found: Findings) -> Section:
    machine = found.machine
    records = [proof.record for proof in found.proofs.values() if proof.record is not None]
    rows = [
        ["customer", found.options.customer or "-"],
        ["site", found.options.site or "-"],
        ["operator", found.options.by or "-"],
        ["machine", machine.machine.name],
        ["serial numbers of the drives", ", ".join(f"{each.axis} {each.serial}" for each in records) or "-"],
        ["configuration, digest", machine.digest],
        ["cycle", f"{machine.machine.sync_period_s * 1e3:g} ms"],
    ]
    for axis, section in machine.axis.items():
        rapid = f"{section.rapid_speed_mm_s * 0.06:g} m/min"
        if section.unit == "deg":
            rapid = section.format_in_unit(section.rapid_speed_mm_s, "/s", "g")
        reach = f"{section.format_in_unit(section.screw_pitch_mm, form='g')} a turn, rapid {rapid}"
        rows.append([f"axis {axis}", f"{reach}, at most {section.max_acceleration_mm_s2 / 1e3:g} m/s²"])
    points = [[str(number), point] for number, point in enumerate(found.open_points, 1)]
    tables = [Table(("", "open point"), points)] if points else []
    text = "No open points: every drive is commissioned and identified"
    text = "" if points else f"{text}, and all limits are kept." if found.options.limits else f"{text}."
    if not found.options.limits:
        text = f"{text} {NO_LIMIT.capitalize()}.".lstrip()
    return Section("The machine", text, [*tables, Table(("", "value"), rows)])


def _build_proof_section(found: Findings) -> Section:
    columns = [_format_proof_column(proof) for proof in found.proofs.values()]
    rows = [[what, *cells] for what, *cells in zip(PROOF_ROWS, *columns, strict=True)]
    steps = [[axis, name, time.replace("T", " ")[:16]] for axis, proof in found.proofs.items()
             for name, time in proof.steps.items()]  # fmt: skip
    head = ("", *(f"axis {axis}" for axis in found.proofs))
    tables = [Table(head, rows, "Verified on the drive by fdhil commission")]
    if steps:
        tables.append(Table(("axis", "step", "done (UTC)"), steps, "Completed steps"))
    return Section("Commissioning", "", tables)


def _format_proof_column(proof: AxisProof) -> list[str]:
    record = proof.record
    if record is None:
        return [*["-"] * (len(PROOF_ROWS) - 1), proof.against]
    return [
        f"{record.vendor_id:#x}, {record.product_code:#x}, {record.revision:#x}", str(record.serial),
        "yes" if record.readback_ok else "no", f"{record.sign_test_um:+.1f} um",
        f"{record.following_error_window_um:g} um", record.watchdog, record.created_utc[:16].replace("T", " "),
        record.digest[:16], proof.against or "-",
    ]  # fmt: skip


def _build_parameter_section(found: Findings) -> Section:
    shares = found.machine.maintenance.model_dump()
    tables = [Table(LATEST_HEAD, build_latest_rows(history, shares), f"Axis {history.axis}")
              for history in found.histories if history.rows]  # fmt: skip
    text = (
        f"The newest published parameters, identified from rapid moves; {INTERVAL_MEANING}."
        if tables
        else "None published yet."
    )
    return Section("Parameters", text, tables)


def _build_circular_section(found: Findings) -> Section:
    options = found.options
    columns = [
        [f"{um:.2f}" for um in (*circle.deviations_um, circle.both_um, circle.hysteresis_um, *circle.radial_um)]
        for circle in found.circles.values()
    ]
    rows = [[what, *cells] for what, *cells in zip(CIRCLE_ROWS, *columns, strict=True)]
    whose = "identified" if found.identified else "nominal"
    pictures = [
        (f"Circular test, {label}: radius {options.radius_mm:g} mm", draw_polar(circle, found.plane or ("X", "Y")))
        for label, circle in found.circles.items()
    ]
    return Section(
        f"Circular test after ISO 230-4, plane {''.join(found.plane or ())}",
        f"Radius {options.radius_mm:g} mm, feed {options.feed_mm_min:g} mm/min, both directions, middle 360 degrees of "
        f"each run; predictions use the {whose} parameters. G is the distance of two concentric circles that enclose a "
        "run, H the distance of both runs at one angle, F the deviation outside (+) or inside (-) the programmed "
        "circle, relative to the least-squares centre. F includes the contraction by the NC's smoothing.",
        [Table(("", *found.circles), rows)],
        pictures,
    )


def _build_operation_section(found: Findings) -> Section:
    head = ("time", "severity", "what")
    passes, notices = (
        [[format_minute(n["time"]), n["severity"], n["text"]] for n in entries]
        for entries in (found.passes, found.notices)
    )
    tables = [Table(head, rows, title) for rows, title in
              ((passes, "Passes with the correction"), (notices, "Open notices")) if rows]  # fmt: skip
    late = "The latency of this PC was not measured: run fdhil doctor --latency 600."
    if found.latency is not None:
        late = f"This PC, measured {format_minute(found.latency['time'])}: {format_latency(found.latency)}."
    none = [what for what, rows in (("No pass with the correction.", passes), ("No open notices.", notices))
            if not rows]  # fmt: skip
    return Section("In operation", " ".join([*none, late]), tables)


def _build_signature_section(found: Findings, document: Mapping[str, Any]) -> Section:
    names = (found.options.by or LINE, LINE)
    rows = [[who, name, LINE, LINE] for who, name in zip(SIGNATURES, names, strict=True)]
    text = f"SHA-256 of the content, as printed by fdhil acceptance --json: {document['sha256']}"
    return Section("Signatures", text, [Table(("", "name", "date, place", "signature"), rows)])
