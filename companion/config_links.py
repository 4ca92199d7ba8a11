"""``[mavlink]``, ``[zenoh]``, ``[ros2]`` and ``[http]``: where the daemon listens and to whom it talks."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from companion.config_types import Positive, Section

Topic = Annotated[str, Meta(pattern=r"^/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$", max_length=120)]
FrameId = Annotated[str, Meta(min_length=1, max_length=64)]
TypeHash = Annotated[str, Meta(pattern=r"^RIHS01_[0-9a-f]{64}$")]
KeyPrefix = Annotated[str, Meta(pattern=r"^([A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*)?$")]


class SigningConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    key_file: str | None = None  # of mode 0600; None: nothing is signed and nothing needs to be
    state_file: str | None = None  # timestamps kept over restarts; None: the clock alone
    link_id: Annotated[int, Meta(ge=0, le=247)] = 0  # of mavlink.url; mavlink.links count up from it
    allow_unsigned: tuple[Literal["RADIO_STATUS", "ADSB_VEHICLE"], ...] = ("RADIO_STATUS", "ADSB_VEHICLE")


class MavlinkConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    url: str = "udpin://127.0.0.1:14540"
    system_id: Annotated[int, Meta(ge=1, le=255)] | None = None  # None: latch the one autopilot heard for 3 s
    heartbeat_timeout_s: Positive = 5.0
    links: Annotated[tuple[str, ...], Meta(max_length=8)] = ()  # further links: ground station, sensors
    forward: bool = False  # pass messages on between the links
    block_other_setpoints: bool = False  # do not pass on setpoints of others to the autopilot while we fly it
    signing: SigningConfig = SigningConfig()


class ZenohTlsConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """PEM files for endpoints ``tls/HOST:PORT``; one certificate serves listening and connecting."""

    ca: str | None = None  # certificates of the authorities that vouch for the others
    certificate: str | None = None  # our own
    private_key: str | None = None  # of it, mode 0600
    mutual: bool | None = None  # whoever connects must show a certificate too; None: the file's, else false


class ZenohConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    config_file: str | None = None  # a stock Zenoh configuration; what is set here overrides it
    mode: Literal["peer", "client", "router"] | None = None  # None: the file's, else peer
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    multicast_scouting: bool | None = None  # None: the file's, else off
    user: str | None = None  # our name where we connect
    password_file: str | None = None  # one line, mode 0600
    users_file: str | None = None  # lines user:password of those who may connect to us, mode 0600
    tls: ZenohTlsConfig = ZenohTlsConfig()


class Ros2Config(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics of ROS 2 nodes on rmw_zenoh; off while none is named. Needs the extra ``ros2``."""

    domain_id: Annotated[int, Meta(ge=0, le=232)] = 0  # ROS_DOMAIN_ID of the nodes
    detections: tuple[Topic, ...] = ()  # of vision_msgs/Detection3DArray
    tracked_objects: tuple[Topic, ...] = ()  # of autoware_perception_msgs/TrackedObjects
    frame_id: FrameId = "map"  # must be the vehicle's local ENU frame
    other_frame_ids: tuple[FrameId, ...] = ()  # that coincide with it, such as "odom"
    key_prefix: KeyPrefix = ""  # before the domain, where the nodes' session has a namespace
    type_hashes: tuple[TypeHash, ...] = ()  # of releases known to be laid out as the current ones


HostName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?$")]


class HttpConfig(Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The page, metrics and health by HTTP; whoever reaches the address may read them."""

    enabled: bool = True
    host: Annotated[str, Meta(min_length=1, max_length=253)] = "127.0.0.1"  # "0.0.0.0": every interface
    port: Annotated[int, Meta(ge=0, le=65535)] | None = (
        None  # None: 8080, or a free one if that is taken; 0: a free one
    )
    names: tuple[HostName, ...] = ()  # by which browsers may call this host, besides its addresses and localhost
    commands: bool = False  # engage, release and set targets, for those who know the token
    token_file: str | None = None  # one line of at least 16 characters, mode 0600
