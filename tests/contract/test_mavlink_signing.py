"""MAVLink 2 signing against pymavlink's own, in both directions, and against the specification by hand."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.config import parse_config
from companion.config_links import SigningConfig
from companion.errors import ConfigError
from companion.link import mav
from companion.link.events import Event, TimesyncReply
from companion.link.mavlink import MavlinkCodec, packet_count
from companion.link.signing import RESERVE, Signing, SigningState, signature, timestamp_at
from companion.link.signing_files import StateFile, open_signing, read_key

KEY = bytes(range(32))
S = 100_000  # timestamps a second
NOW_NS = 1_800_000_000 * 10**9
NOW = (1_800_000_000 - 1_420_070_400) * S


class Time:
    def __init__(self) -> None:
        self.ns = NOW_NS

    def __call__(self) -> int:
        return self.ns


def ours(*, allow_unsigned: tuple[int, ...] = (), key: bytes = KEY) -> MavlinkCodec:
    return MavlinkCodec(signing=Signing(key, Time(), allow_unsigned=allow_unsigned))


def peer(timestamp: int = NOW, *, component: int = 1, key: bytes = KEY, link_id: int = 0) -> dialect.MAVLink:
    """pymavlink with signing on, as its `mavutil.setup_signing` does it."""
    other = dialect.MAVLink(None, 1, component)
    other.robust_parsing = True
    other.signing.secret_key, other.signing.sign_outgoing = key, True
    other.signing.timestamp, other.signing.link_id = timestamp, link_id
    return other


def reply(sender: dialect.MAVLink, number: int = 5) -> bytes:
    return bytes(dialect.MAVLink_timesync_message(number, 7).pack(sender))


def numbers(events: list[Event]) -> list[int]:
    return [event.tc1_ns for event in events if isinstance(event, TimesyncReply)]


def resigned(packet: bytes, *, timestamp: int | None = None, key: bytes = KEY) -> bytes:
    """The packet with its checksum made right, another timestamp and a signature by ``key``."""
    crc_extra = dialect.mavlink_map[int.from_bytes(packet[7:10], "little")].crc_extra
    crc = dialect.x25crc(packet[1:-15] + bytes([crc_extra])).crc
    stamp = packet[-12:-6] if timestamp is None else timestamp.to_bytes(6, "little")
    body = packet[:-15] + crc.to_bytes(2, "little") + packet[-13:-12] + stamp
    return body + hashlib.sha256(key + body).digest()[:6]


# bytes


def test_a_signed_heartbeat_byte_by_byte() -> None:
    """The specification by hand: flag 0x01, then link id, 48 bits of 10 us since 2015, SHA-256's first six bytes."""
    codec = MavlinkCodec(system=1, signing=Signing(KEY, Time(), link_id=9))
    packet = codec.seal(codec.encode_heartbeat(mav.STATE_ACTIVE))
    header_and_payload = bytes.fromhex("fd 09 01 00 00 01 c4 00 00 00") + bytes.fromhex("00 00 00 00 12 08 01 04 03")
    crc = dialect.x25crc(header_and_payload[1:] + bytes([50])).crc.to_bytes(2, "little")  # CRC_EXTRA of HEARTBEAT
    block = b"\x09" + NOW.to_bytes(6, "little")
    assert packet[:-6] == header_and_payload + crc + block
    assert packet[-6:] == hashlib.sha256(KEY + header_and_payload + crc + block).digest()[:6]


def test_epoch_is_2015_in_ten_microseconds() -> None:
    assert timestamp_at(1_420_070_400 * 10**9) == 0
    assert timestamp_at(NOW_NS) == NOW
    assert timestamp_at(NOW_NS + 9_999) == NOW
    assert timestamp_at(0) == 0
    assert timestamp_at(2**80) == 2**48 - 1


def test_pymavlink_takes_what_we_sign() -> None:
    codec, other = ours(), peer(NOW - 30 * S)
    data = b"".join(
        [codec.encode_heartbeat(4), codec.encode_statustext(6, "long " * 30), codec.encode_timesync_request(3)]
    )
    messages = other.parse_buffer(codec.seal(data))
    assert [m.get_type() for m in messages] == ["HEARTBEAT", *["STATUSTEXT"] * 4, "TIMESYNC"]
    assert all(m.get_signed() for m in messages)
    assert (other.signing.goodsig_count, other.signing.badsig_count) == (6, 0)


def test_pymavlink_refuses_what_we_sign_with_another_key() -> None:
    codec, other = ours(), peer(NOW - 30 * S, key=bytes(32))
    assert [m.get_type() for m in other.parse_buffer(codec.seal(codec.encode_heartbeat(4)))] == ["BAD_DATA"]


def test_what_is_encoded_early_and_sent_late_is_taken() -> None:
    """The timestamp is that of leaving: a queue that is overtaken would be full of replays otherwise."""
    codec, other = ours(), peer(NOW - 30 * S)
    early, late = codec.encode_statustext(6, "queued"), codec.encode_heartbeat(4)
    assert [m.get_type() for m in other.parse_buffer(codec.seal(late) + codec.seal(early))] == [
        "HEARTBEAT",
        "STATUSTEXT",
    ]


def test_every_link_of_ours_is_a_stream_of_its_own() -> None:
    """One receiver on two links of different delay refuses neither."""
    codec, other = ours(), peer(NOW - 30 * S)
    slow, fast = codec.seal(codec.encode_heartbeat(4), 0), codec.seal(codec.encode_heartbeat(4), 1)
    assert (slow[-13], fast[-13]) == (0, 1)
    assert all(m.get_signed() for m in other.parse_buffer(fast + slow))


def test_we_take_what_pymavlink_signs() -> None:
    codec, other = ours(), peer()
    assert numbers(codec.receive(b"".join(reply(other, number) for number in range(1, 5)))) == [1, 2, 3, 4]
    assert codec.counts["messages"] == 4


def test_a_message_says_whether_it_was_proven() -> None:
    codec, other = ours(allow_unsigned=(109,)), peer()
    radio = dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    framer = codec.new_framer()
    proven, unproven = framer.push(reply(other) + radio.pack(dialect.MAVLink(None, 51, 68)))
    assert (proven.get_signed(), unproven.get_signed()) == (True, False)
    assert codec.counts["allowed_unsigned"] == 1


def test_packets_are_counted_signed_or_not() -> None:
    for codec in (ours(), MavlinkCodec()):
        assert packet_count(codec.encode_heartbeat(4) + codec.encode_statustext(6, "x" * 120)) == 4


# refusals


@pytest.mark.parametrize("version_1", [False, True])
def test_unsigned_is_refused_but_for_the_allowlist(version_1: bool) -> None:
    codec, plain = ours(allow_unsigned=(246,)), dialect.MAVLink(None, 1, 1)
    adsb = dialect.MAVLink_adsb_vehicle_message(1, 2, 3, 0, 4, 5, 6, 7, b"ID", 0, 0, 0, 0)
    assert codec.receive(dialect.MAVLink_timesync_message(5, 7).pack(plain, force_mavlink1=version_1)) == []
    assert codec.counts == {"unsigned": 1}
    codec.receive(adsb.pack(plain))
    assert codec.counts["messages"] == 1


def test_an_allowed_message_with_a_wrong_signature_is_refused() -> None:
    codec = ours(allow_unsigned=(109,))
    radio = dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7).pack(peer(key=bytes(32)))
    codec.receive(radio)
    assert codec.counts == {"bad_signature": 1}


def test_a_replay_is_refused_on_every_link() -> None:
    codec, other = ours(), peer()
    first, second = reply(other, 1), reply(other, 2)
    one, two = codec.new_framer(), codec.new_framer()
    assert len(one.push(second)) == 1
    assert one.push(second) == two.push(second) == two.push(first) == []
    assert codec.counts["replayed"] == 3


def test_streams_are_told_apart() -> None:
    """Each of system, component and link id counts its own time."""
    codec = ours()
    assert numbers(codec.receive(reply(peer(NOW + 50), 1))) == [1]
    assert numbers(codec.receive(reply(peer(NOW, component=2), 2))) == [2]
    assert numbers(codec.receive(reply(peer(NOW, link_id=1), 3))) == [3]
    assert codec.receive(reply(peer(NOW), 4)) == []


@pytest.mark.parametrize(
    ("offset", "refusal"), [(60 * S, None), (60 * S + 1, "future"), (-60 * S, "replayed"), (-60 * S + 1, None)]
)
def test_a_minute_either_way(offset: int, refusal: str | None) -> None:
    codec = ours()
    assert len(codec.receive(reply(peer(NOW + offset)))) == (refusal is None)
    assert codec.counts[refusal or "messages"] == 1


def test_a_stream_known_already_may_be_far_behind_the_clock() -> None:
    """pymavlink counts packets, not time: a quiet peer falls behind."""
    clock = Time()
    codec, other = MavlinkCodec(signing=Signing(KEY, clock)), peer()
    codec.receive(reply(other, 1))
    clock.ns += 3600 * 10**9
    assert numbers(codec.receive(reply(other, 2))) == [2]


def test_a_forged_future_timestamp_locks_nobody_out() -> None:
    codec, genuine = ours(), peer()
    assert numbers(codec.receive(reply(genuine, 1))) == [1]
    for ahead in (1, 30 * S, 3600 * S, 2**47):
        forged = resigned(reply(peer()), timestamp=NOW + ahead, key=b"x" * 32)
        assert codec.receive(forged) == []
    assert codec.counts["bad_signature"] == 4
    assert numbers(codec.receive(reply(genuine, 2))) == [2]


def test_the_same_forgery_locks_pymavlink_out() -> None:
    """pymavlink 2.4.50's `check_signature`; should this fail, a later release is mended and facts have changed."""
    receiver, genuine = peer(NOW), peer()
    assert [m.get_type() for m in receiver.parse_buffer(reply(genuine, 1))] == ["TIMESYNC"]
    receiver.parse_buffer(resigned(reply(peer()), timestamp=NOW + 3600 * S, key=b"x" * 32))
    assert [m.get_type() for m in receiver.parse_buffer(reply(genuine, 2))] == ["BAD_DATA"]


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_flipped_bit_is_refused(data: st.DataObject) -> None:
    packet = bytearray(reply(peer()))
    bit = data.draw(st.integers(0, 8 * len(packet) - 1))
    packet[bit // 8] ^= 1 << bit % 8
    codec = ours()
    assert codec.receive(bytes(packet) + bytes(300)) == []
    assert codec.counts["messages"] == 0


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_any_changed_byte_is_refused_even_with_its_checksum_made_right(data: st.DataObject) -> None:
    good = reply(peer())
    at = data.draw(st.sampled_from([3, 4, 5, 6, *range(10, len(good) - 15), *range(len(good) - 13, len(good))]))
    packet = bytearray(good)
    packet[at] ^= data.draw(st.integers(1, 255))
    crc = dialect.x25crc(packet[1:-15] + bytes([dialect.MAVLink_timesync_message.crc_extra])).crc
    packet[-15:-13] = crc.to_bytes(2, "little")
    codec = ours()
    assert codec.receive(bytes(packet)) == []
    assert codec.counts == {"bad_signature": 1}
    assert numbers(codec.receive(good)) == [5]  # and it left no trace


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=6), st.booleans())
def test_random_bytes_never_raise(chunks: list[bytes], wrapped: bool) -> None:
    codec = ours()
    framer = codec.new_framer()
    for chunk in chunks:
        framer.push(b"\xfd\x00\x01" + chunk if wrapped else chunk)
    assert codec.counts["messages"] == 0


# timestamps of our own


def stamps(codec: MavlinkCodec, count: int) -> list[int]:
    return [int.from_bytes(codec.seal(codec.encode_heartbeat(4))[-12:-6], "little") for _ in range(count)]


def test_timestamps_never_repeat_though_the_clock_stands_or_goes_back() -> None:
    clock = Time()
    codec = MavlinkCodec(signing=Signing(KEY, clock))
    assert stamps(codec, 3) == [NOW, NOW + 1, NOW + 2]
    clock.ns -= 3600 * 10**9
    assert stamps(codec, 2) == [NOW + 3, NOW + 4]
    clock.ns += 3601 * 10**9
    assert stamps(codec, 1) == [NOW + S]


def test_what_is_heard_moves_our_own_time_on() -> None:
    codec = ours()
    codec.receive(reply(peer(NOW + 40 * S)))
    assert stamps(codec, 1) == [NOW + 40 * S + 1]
    codec.receive(resigned(reply(peer()), timestamp=NOW + 50 * S, key=b"x" * 32))
    assert stamps(codec, 1) == [NOW + 40 * S + 2]


class Disk:
    """What was kept, as the state file keeps it."""

    def __init__(self) -> None:
        self.states: list[SigningState] = []


def restarted(disk: Disk, clock: Callable[[], int], reports: list[str] | None = None) -> Signing:
    return Signing(
        KEY,
        clock,
        state=disk.states[-1] if disk.states else None,
        persist=disk.states.append,
        on_report=None if reports is None else reports.append,
    )


def test_a_restart_with_the_clock_behind_goes_on_where_it_was() -> None:
    disk, clock, reports = Disk(), Time(), []
    signing = restarted(disk, clock)
    last = [signing.next_timestamp() for _ in range(100)][-1]
    clock.ns -= 7200 * 10**9  # no battery behind the clock
    again = restarted(disk, clock, reports)  # after a crash: nothing was closed
    assert again.next_timestamp() > last
    assert len(reports) == 1
    assert "ahead of the clock" in reports[0]
    assert "is used" in reports[0]
    # the autopilot, whose clock is right, is heard all the same
    assert MavlinkCodec(signing=again).receive(reply(peer(NOW + 5 * S))) != []


def test_a_crash_repeats_nothing_and_a_clean_end_skips_nothing() -> None:
    disk, clock = Disk(), Time()
    signing = restarted(disk, clock)
    for _ in range(50):
        sent = signing.next_timestamp()
        assert disk.states[-1].transmit >= sent  # kept before it is used
        clock.ns += 10**9
    assert len(disk.states) == 5  # every 10 s, not every packet
    assert restarted(disk, lambda: NOW_NS).next_timestamp() == disk.states[-2].transmit + 1
    signing.close()
    assert disk.states[-1].transmit == sent
    assert disk.states[-1].transmit < sent + RESERVE


def test_a_kept_timestamp_of_the_far_future_is_not_used_and_told() -> None:
    reports: list[str] = []
    far = SigningState(NOW + 25 * 3600 * S, ((1, 1, 0, NOW + 25 * 3600 * S),))
    signing = Signing(KEY, Time(), state=far, on_report=reports.append)
    assert signing.next_timestamp() == NOW
    assert "not used" in reports[0]
    assert MavlinkCodec(signing=signing).receive(reply(peer())) != []  # nor does it lock a stream out


def test_a_recording_of_before_the_restart_is_refused_after_it() -> None:
    disk, clock = Disk(), Time()
    other = peer()
    recorded = reply(other)
    signing = restarted(disk, clock)
    assert MavlinkCodec(signing=signing).receive(recorded) != []
    signing.close()
    codec = MavlinkCodec(signing=restarted(disk, clock))
    assert codec.receive(recorded) == []
    assert codec.counts == {"replayed": 1}
    assert codec.receive(reply(other)) != []


def test_a_clock_that_was_ahead_and_is_put_right_locks_nobody_out() -> None:
    clock = Time()
    codec = MavlinkCodec(signing=Signing(KEY, clock))
    clock.ns += 86_400 * 10**9
    assert codec.receive(reply(peer(NOW + 86_400 * S), 1)) != []
    clock.ns = NOW_NS
    assert numbers(codec.receive(reply(peer(NOW), 2))) == [2]


def test_streams_are_bounded() -> None:
    signing = Signing(KEY, Time())
    codec = MavlinkCodec(signing=signing)
    for component in range(2, 250):
        for link_id in range(2):
            codec.receive(reply(peer(NOW, component=component, link_id=link_id)))
    assert codec.counts["messages"] == 496
    assert len(signing._streams) == 256


# files


@pytest.fixture
def key_file(tmp_path: Path) -> Iterator[Callable[..., Path]]:
    def make(content: bytes = KEY, mode: int = 0o600) -> Path:
        path = tmp_path / "key"
        path.unlink(missing_ok=True)
        path.write_bytes(content)
        path.chmod(mode)
        return path

    return make


@pytest.mark.parametrize("mode", [0o600, 0o400])
def test_an_owners_key_file_is_read(key_file: Any, mode: int) -> None:
    assert read_key(key_file(mode=mode)) == KEY


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o660, 0o602, 0o700])
def test_a_key_file_open_to_others_is_refused(key_file: Any, mode: int) -> None:
    with pytest.raises(ConfigError, match=rf"key: expected mode 0600 or less .*, got {mode:04o}$") as caught:
        read_key(key_file(mode=mode))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "key"),
    [
        (KEY, KEY),
        (KEY.hex().encode(), KEY),
        (KEY.hex().upper().encode() + b"\n", KEY),
        (b"passphrase:open sesame\n", hashlib.sha256(b"open sesame").digest()),
        (b"passphrase:open sesame", hashlib.sha256(b"open sesame").digest()),
        ("passphrase:Schlüssel".encode(), hashlib.sha256("Schlüssel".encode()).digest()),
    ],
)
def test_three_ways_to_write_a_key(key_file: Any, content: bytes, key: bytes) -> None:
    assert read_key(key_file(content)) == key


@pytest.mark.parametrize(
    "content",
    [b"", KEY[:31], KEY + b"\n", b"x" * 64, KEY.hex().encode()[:-1], b"passphrase:", b"passphrase:a\nb\n", b"y" * 9000],
)
def test_what_is_no_key_is_refused_without_quoting_it(key_file: Any, content: bytes) -> None:
    with pytest.raises(ConfigError, match=r"expected 32 bytes, 64 hex digits, or one line passphrase:TEXT$") as caught:
        read_key(key_file(content))
    assert "\n" not in str(caught.value)


def test_a_missing_key_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mavlink\.signing\.key_file .*absent: cannot be read \(No such file"):
        read_key(tmp_path / "absent")
    with pytest.raises(ConfigError, match="expected a regular file of mode 0600"):
        read_key(tmp_path)


def test_the_state_file_survives_and_is_the_owners(tmp_path: Path) -> None:
    reports: list[str] = []
    file = StateFile(tmp_path / "state", reports.append)
    assert file.read() is None
    state = SigningState(NOW, ((1, 1, 0, NOW - 5),))
    file.write(state)
    assert file.read() == state
    assert (tmp_path / "state").stat().st_mode & 0o777 == 0o600
    assert [path.name for path in tmp_path.iterdir()] == ["state"]
    assert reports == []


@pytest.mark.parametrize("content", [b"", b"{}", b'{"transmit": -1}', b'{"transmit": 1, "streams": [[1]]}', b"\xff"])
def test_a_damaged_state_file_is_told_and_replaced(tmp_path: Path, content: bytes) -> None:
    reports: list[str] = []
    (tmp_path / "state").write_bytes(content)
    file = StateFile(tmp_path / "state", reports.append)
    assert file.read() is None
    assert "state: holds no signing state" in reports[0]


def test_a_state_file_that_cannot_be_written_is_told_once(tmp_path: Path) -> None:
    reports: list[str] = []
    file = StateFile(tmp_path / "absent" / "state", reports.append)
    file.write(SigningState(1))
    file.write(SigningState(2))
    assert len(reports) == 1
    assert "cannot be written" in reports[0]


def test_signing_as_configured(key_file: Any, tmp_path: Path) -> None:
    config = SigningConfig(key_file=str(key_file()), state_file=str(tmp_path / "state"), link_id=3)
    signing = open_signing(config, Time(), pytest.fail)
    assert signing is not None
    codec = MavlinkCodec(signing=signing)
    packet = codec.seal(codec.encode_heartbeat(4))
    assert packet[-13] == 3
    assert packet[-6:] == signature(KEY, packet[:-6])
    codec.close()
    again = open_signing(config, lambda: NOW_NS - 10**10, pytest.fail)
    assert again is not None
    assert again.next_timestamp() == NOW + 1
    radio = dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7).pack(dialect.MAVLink(None, 51, 68))
    codec.receive(radio)
    assert codec.counts["allowed_unsigned"] == 1


def test_without_a_key_nothing_is_signed() -> None:
    assert open_signing(SigningConfig(), Time(), pytest.fail) is None
    codec = MavlinkCodec()
    assert codec.seal(codec.encode_heartbeat(4))[2] == 0
    with pytest.raises(ConfigError, match=r"mavlink\.signing\.state_file: expected only together with"):
        open_signing(SigningConfig(state_file="x"), Time(), pytest.fail)


def test_only_what_can_do_no_harm_may_be_allowed_unsigned() -> None:
    with pytest.raises(ConfigError, match=r"mavlink\.signing\.allow_unsigned"):
        parse_config({"mavlink": {"signing": {"allow_unsigned": ["COMMAND_LONG"]}}})
