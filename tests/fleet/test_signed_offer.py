"""An offer is accepted only if a trusted key signed exactly these bytes, and its changes are allowed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import nkeys
import pytest
from pydantic import ValidationError

from fdhil.config.config_template import list_tables
from fdhil.config.offers_section import Offers
from fdhil.config.remote_change_policy import FROM_AFAR, NEVER, explain_refusal, is_loosening
from fdhil.errors import ConfigError
from fdhil.fleet.signed_offer import (
    SCHEMA,
    Offer,
    OfferRefused,
    create_key,
    encode_canonical,
    read_offer,
    read_public_key,
    sign_offer,
)
from tests.fleet.offer_signing import TOLD, OfferSigner


@pytest.fixture
def offer_signer(tmp_path: Path) -> OfferSigner:
    return OfferSigner(tmp_path)


def test_signed_offer_round_trips(offer_signer: OfferSigner) -> None:
    values = {
        "axis.*.nominal.ft": 0.1 + 0.2,
        "nc.smoothing_s": (0.06, 0.03),
        "nc.rapid_stop": False,
        "nc.profile": "fir",
    }
    document = offer_signer.sign_document(values=values, axis_labels={"screw": "Müller"})
    offer = read_offer(document, {offer_signer.public})
    assert dict(offer.values) == values
    assert (offer.axis_labels, offer.machines, offer.version) == ({"screw": "Müller"}, ("mill-1",), 3)


@pytest.mark.parametrize("bit", [0x01, 0x20, 0x80])
def test_any_changed_byte_is_detected(bit: int, offer_signer: OfferSigner) -> None:
    document = offer_signer.sign_document()
    accepted = []
    for at in range(len(document)):
        changed = bytearray(document)
        changed[at] ^= bit
        try:
            read_offer(bytes(changed), {offer_signer.public})
        except OfferRefused:
            continue
        accepted.append(at)
    assert accepted == []


def test_truncated_extended_or_doubled_offer_is_refused(offer_signer: OfferSigner) -> None:
    document = offer_signer.sign_document()
    wrong = [document[:at] for at in range(len(document))]
    wrong += [document + b"\n", document + b" ", b" " + document, document * 2, document.upper()]
    for each in wrong:
        with pytest.raises(OfferRefused):
            read_offer(each, {offer_signer.public})


def test_unlisted_key_is_refused_and_several_keys_are_accepted(offer_signer: OfferSigner, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = OfferSigner(tmp_path / "other")
    with pytest.raises(OfferRefused, match="not listed in \\[offers\\] trust"):
        read_offer(other.sign_document(), {offer_signer.public})
    with pytest.raises(OfferRefused, match="not listed"):
        read_offer(offer_signer.sign_document(), ())
    for signer in (offer_signer, other):  # while one key follows another
        assert read_offer(signer.sign_document(), {offer_signer.public, other.public}).version == 3
    stolen = other.sign_document().replace(other.public.encode(), offer_signer.public.encode())
    with pytest.raises(OfferRefused, match="changed after it was signed"):
        read_offer(stolen, {offer_signer.public})


def test_signed_offer_not_in_canonical_form_is_refused(offer_signer: OfferSigner) -> None:
    pair = nkeys.from_seed(offer_signer.key.read_bytes().strip())

    def sign_line(line: bytes) -> bytes:
        return (
            line
            + f"\n{SCHEMA} {offer_signer.public} {pair.sign(SCHEMA.encode() + bytes([10]) + line).hex()}\n".encode()
        )

    line = encode_canonical(Offer(**TOLD))
    assert read_offer(sign_line(line), {offer_signer.public}).version == 3
    reported = json.loads(line)
    wrong = [
        line.replace(b'"version":3', b'"version":"3"'),
        line.replace(b'"version":3', b'"version":2,"version":3'),
        line.replace(b":", b": ", 1),
        json.dumps(reported | {"values": {"guard.node_id": 5}}, sort_keys=True, separators=(",", ":")).encode(),
        json.dumps(reported | {"more": 1}, sort_keys=True, separators=(",", ":")).encode(),
        b"[" * 5000,
        b"",
        b"\xff",
    ]
    for each in wrong:
        with pytest.raises(OfferRefused):
            read_offer(sign_line(each), {offer_signer.public})
    plain = line + f"\n{SCHEMA} {offer_signer.public} {pair.sign(line).hex()}\n".encode()  # signed for another purpose
    with pytest.raises(OfferRefused, match="changed"):
        read_offer(plain, {offer_signer.public})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"values": {"guard.node_id": 5}}, "senders of set-points and heartbeats"),
        ({"values": {"axis.X.drive.sign": -1}}, "construction and wiring"),
        ({"values": {"axis.X.setpoints.max_speed_mm_s": 5.0}}, "senders of set-points and heartbeats"),
        ({"values": {"offers.trust": "O"}}, "access and trust"),
        ({"values": {"access.operate": "anna"}}, "access and trust"),
        ({"values": {"store.directory": "/"}}, "files, sockets and limits"),
        ({"values": {"axis.*.nominal.ft": 1.0}}, "name them"),
        ({"values": {"axis.X.nominal.ft": float("nan")}}, "finite"),
        ({"values": {}}, "at least 1"),
        ({"labels": {}, "machines": ()}, "no machines and no labels"),
        ({"name": "../../etc"}, "match pattern"),
        ({"version": 0}, "greater than"),
    ],
)
def test_forbidden_change_cannot_be_signed(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Offer(**(TOLD | changes))


def test_invalid_value_is_not_signed(offer_signer: OfferSigner) -> None:
    for path, value in (("axis.X.nominal.ft", -1.0), ("axis.*.nominal.friction", 1.0), ("nc.profile", "magic")):
        with pytest.raises(ConfigError):
            offer_signer.sign_document(values={path: value}, axis_labels={"screw": "A"})


def test_every_config_key_has_a_remote_change_policy() -> None:
    """A new section needs a policy for itself or for a table above it."""
    for table in list_tables():
        for key, _ in table.keys:
            path = f"{table.path}.{key}"
            assert explain_refusal(path) != "no remote change of it is allowed", path
    assert all(explain_refusal(path.replace("*", "X")) for path in NEVER)
    assert not any(explain_refusal(path.replace("axis.*", "axis.Z")) for path in FROM_AFAR)
    assert explain_refusal("nothing.of_the_kind")


def test_larger_limit_loosens_and_smaller_one_does_not() -> None:
    path = "axis.X.correction.max_offset_um"
    assert (is_loosening(path, 50.0, 60.0), is_loosening(path, 50.0, 40.0), is_loosening(path, 50.0, 50.0)) == (
        True,
        False,
        False,
    )
    assert is_loosening("correction.learning", False, True)
    assert not is_loosening("correction.learning", True, False)
    assert is_loosening("identification.tolerance_um", None, 1.0)  # which of the two is larger depends
    assert not is_loosening("axis.X.nominal.ft", 1.0, 2.0)


def test_key_file_readable_by_others_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "key"
    reported = create_key(file)
    assert file.stat().st_mode & 0o777 == 0o600
    assert read_public_key(file) == reported
    assert Offers(trust=(reported,)).trust == (reported,)
    with pytest.raises(FileExistsError):
        create_key(file)
    file.chmod(0o640)
    with pytest.raises(ConfigError, match="can be read by others"):
        sign_offer(Offer(**TOLD), file)
    file.chmod(0o600)
    seed = file.read_bytes()
    users = nkeys.encode_seed(b"7" * 32, nkeys.PREFIX_BYTE_USER)  # that of a server's user
    for wrong in (b"", b"\xff", seed[:20], users, b"A" * 58):
        file.write_bytes(wrong)
        with pytest.raises(ConfigError, match="is not a signing key"):
            read_public_key(file)
    with pytest.raises(ConfigError, match="create one with fdhil fleet key"):
        read_public_key(tmp_path / "absent")


def test_mistyped_key_is_reported(tmp_path: Path) -> None:
    reported = create_key(tmp_path / "key")
    for at in range(len(reported)):
        wrong = reported[:at] + ("A" if reported[at] != "A" else "B") + reported[at + 1 :]
        with pytest.raises(ValidationError, match="mistyped"):
            Offers(trust=(wrong,))
    user = nkeys.from_seed(nkeys.encode_seed(b"7" * 32, nkeys.PREFIX_BYTE_USER)).public_key.decode()
    with pytest.raises(ValidationError, match="not a plant's public key"):
        Offers(trust=(user,))
