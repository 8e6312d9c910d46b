"""[nc_source.modbus_coil], [nc_source.mtconnect], [nc_source.opcua]: where and how the NC is polled."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fdhil import tables
from fdhil.config.section import NotNegative, Positive, Section, require_one_of
from fdhil.config.sensor_sections import MOST_REGISTERS, ModbusDevice

MOST_COILS = 2000  # of one request
Place = Annotated[str, Field(pattern=r"^\d{1,5}(\.\d{1,2})?$")]
BITS_ARE = {"coils": 1, "discrete_inputs": 2, "holding_registers": 3, "input_registers": 4}
NUMBERS_ARE = {"holding_registers": 3, "input_registers": 4}


def _define_bit(description: str) -> Place | None:
    place: Place | None = Field(None, description=f"{description}; left out: not available")
    return place


def _define_register(description: str) -> int | None:
    place: int | None = Field(None, ge=0, le=65535, description=f"register of {description}; left out: not available")
    return place


class ModbusNc(ModbusDevice):
    """[nc_source.modbus_coil]: an NC or its PLC that shows its state in coils or registers."""

    port: int = Field(502, ge=1, le=65535, description="modbus: TCP port")
    bits: Literal["coils", "discrete_inputs", "holding_registers", "input_registers"] = Field(
        "coils", description="location of the bits below: coils, discrete_inputs, holding_registers, input_registers"
    )
    rapid: Place = Field("0", description="the bit that is set during G0: address from 0, in registers '12.3' is bit 3")
    hold: Place | None = _define_bit("the bit of a feed hold")
    feed: Place | None = _define_bit("the bit that is set during G1; with it, no bit set means rest")
    arc: Place | None = _define_bit("the bit that is set during G2 and G3")
    numbers: Literal["holding_registers", "input_registers"] = Field(
        "holding_registers", description="location of the numbers below: unsigned integers, one register each"
    )
    line: int | None = _define_register("the program's line")
    feed_override: int | None = _define_register("the feed override")
    rapid_override: int | None = _define_register("the rapid override")
    tool: int | None = _define_register("the tool's number")
    override_scale: Positive = Field(0.01, ge=1e-6, le=1, description="scale of the overrides; 0.01 for percent")
    period_s: Positive = Field(0.02, ge=1e-3, le=5, description="how often it is polled")
    renewed_s: NotNegative = Field(0.02, le=5, description="how often the NC updates its values: its PLC's cycle")

    def map_signals(self) -> Mapping[str, tuple[int, int, int | None]]:
        """Return function, address and bit (None for coils and numbers) of each configured signal."""
        found: dict[str, tuple[int, int, int | None]] = {}
        for name in ("rapid", "hold", "feed", "arc"):
            if (place := getattr(self, name)) is not None:
                address, _, bit = place.partition(".")
                found[name] = BITS_ARE[self.bits], int(address), int(bit) if bit else None
        for name in ("line", "feed_override", "rapid_override", "tool"):
            if (register := getattr(self, name)) is not None:
                found[name] = NUMBERS_ARE[self.numbers], register, None
        return found

    def plan_requests(self) -> Mapping[int, tuple[int, int]]:
        """Return first address and count of the one read request per function."""
        spans: dict[int, list[int]] = {}
        for function, address, _ in self.map_signals().values():
            spans.setdefault(function, []).append(address)
        return {function: (min(each), max(each) - min(each) + 1) for function, each in spans.items()}

    @property
    def registers(self) -> int:
        """Data read in each poll, in registers."""
        asked = self.plan_requests().items()
        return sum(count if function in NUMBERS_ARE.values() else (count + 15) // 16 for function, (_, count) in asked)

    @model_validator(mode="after")
    def _check_addresses(self) -> Self:
        faults = "\n".join([*self._find_address_faults(), *self._find_span_faults()])
        if faults:
            raise ValueError(faults)
        return self

    def _find_address_faults(self) -> Iterator[str]:
        in_registers = self.bits in NUMBERS_ARE
        for name, (function, address, bit) in self.map_signals().items():
            if address > 65535 or (bit is not None and bit > 15):
                yield f"{name}: addresses end at 65535, the bits of a register at 15"
            elif function == BITS_ARE[self.bits] and name in ("rapid", "hold", "feed", "arc"):
                if in_registers and bit is None:
                    yield f"{name}: is a register without a bit; give one, as '{address}.0'"
                elif not in_registers and bit is not None:
                    yield f"{name}: {self.bits} have no bits; give their address alone, or bits = 'holding_registers'"

    def _find_span_faults(self) -> Iterator[str]:
        for function, (first, count) in self.plan_requests().items():
            most = MOST_COILS if function < min(NUMBERS_ARE.values()) else MOST_REGISTERS
            if count > most:
                yield f"addresses {first} to {first + count - 1} are too far apart: one request reads {most}"


class PolledNc(Section):
    """An NC that is polled over the network and translated by a profile."""

    period_s: Positive = Field(0.1, ge=5e-3, le=5, description="how often it is polled, or sends changes")
    renewed_s: NotNegative = Field(0.1, le=5, description="how often the agent or server updates its values")
    profile: str = Field("", description="profile of the NC's signals")

    def resolve_paths(self, folder: Path) -> Self:
        changes: dict[str, Any] = {key: folder / value for key, value in self if isinstance(value, Path)}
        own = self.profile not in tables.NC_PROFILES
        return self.model_copy(update=changes | ({"profile": str(folder / self.profile)} if own else {}))


class MtConnectNc(PolledNc):
    """[nc_source.mtconnect]: an MTConnect agent of the NC."""

    url: str = Field("http://127.0.0.1:5000", pattern=r"^http://[^/\s]+(/\S*)?$", description="the agent")
    device: str = Field("", description="name or uuid of the device; left out: the agent has only one")
    path: str = Field("", description="name or componentId of the path; left out: the device has only one")
    profile: Annotated[str, require_one_of(tables.NC_PROFILES, or_suffix=".toml")] = Field(
        "mtconnect", description="mtconnect, or the path of a TOML file, from this file's folder"
    )


class OpcUaNc(PolledNc):
    """[nc_source.opcua]: an OPC UA server in the NC (needs the extra opcua)."""

    url: str = Field("opc.tcp://127.0.0.1:4840", pattern=r"^opc\.tcp://\S+$", description="the server's end point")
    profile: Annotated[str, require_one_of(tables.NC_PROFILES, or_suffix=".toml")] = Field(
        "opc40502",
        description="profile of the NC's signals: siemens, heidenhain, beckhoff, opc40502 (the CNC companion "
        "specification), or the path of a TOML file, from this file's folder",
    )
    timeout_s: Positive = Field(2.0, ge=0.05, le=60, description="longest time for an answer")
    user: str | None = Field(None, min_length=1, description="the server's user; left out: anonymous")
    password_file: Path | None = Field(None, description="file with the user's password, mode 0600")
    certificate: Path | None = Field(None, description="fdhil's certificate, to sign and encrypt (Basic256Sha256)")
    private_key: Path | None = Field(None, description="private key of that certificate, mode 0600")
    server_certificate: Path | None = Field(None, description="the server's certificate; left out: any is accepted")

    @model_validator(mode="after")
    def _check_credentials(self) -> Self:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("certificate: certificate and private_key must be given together")
        if self.server_certificate is not None and self.certificate is None:
            raise ValueError("server_certificate: it needs a certificate and a private_key")
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user: user and password_file must be given together")
        return self
