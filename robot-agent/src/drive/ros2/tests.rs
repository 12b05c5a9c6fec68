//! The drive from a message's bytes to the loop and back, with everything but zenoh.

use jiff::Timestamp;
use tread_control::robot::GRAVITY_M_S2;
use tread_ros2::cdr::{Sequence, encode};
use tread_ros2::messages::{Header, Imu, JointState, Quaternion, Time, Vector3};
use tread_ros2::names::Name;
use tread_ros2::rmw::{Attachment, Generation, topic_key};

use super::refusal::{DropMonitor, Notice};
use super::settings::*;
use super::*;
use crate::clock::{Clock as _, ManualClock};

const NAMES: [&str; 2] = ["left", "right"];
const STEP: Duration = Duration::from_millis(10);
const COMMANDED: WheelSpeeds = WheelSpeeds {
    left_rad_s: 4.0,
    right_rad_s: 5.0,
};

pub(crate) fn topic(text: &str) -> Name {
    Name::topic(text, &Name::default()).unwrap()
}

pub(crate) fn settings() -> Ros2Settings {
    let side = |name: &str| SideJoints {
        names: vec![name.to_owned()],
        sign: 1.0,
        effort_sign: 1.0,
    };
    Ros2Settings {
        bus: BusSettings {
            scheme: Scheme::RmwZenoh(Generation::Hashed),
            mode: BusMode::Client,
            endpoint: "tcp/127.0.0.1:7447".to_owned(),
            domain: 0,
            namespace: Name::default(),
            node: Name::node("tread_agent").unwrap(),
        },
        timing: Timing {
            stamps: StampClock::Host,
            silent_after: Duration::from_millis(100),
            late_after: Duration::from_millis(100),
            pose_late_after: Duration::from_millis(300),
        },
        odometry: None,
        imu: Some(ImuSettings {
            topic: topic("imu"),
            frame: "imu_link".to_owned(),
            yaw_rad: 0.0,
            is_upside_down: false,
        }),
        joints: Some(JointSettings {
            topic: topic("joint_states"),
            left: side("left"),
            right: side("right"),
            gear_ratio: 2.0,
            effort: Effort::Current(0.5),
        }),
        pose: None,
        battery: None,
        command: CommandSettings {
            topic: topic("cmd_vel"),
            kind: CommandKind::Twist,
            frame: "base_link".to_owned(),
            base_radius_m: 0.1,
            base_track_m: 0.5,
            turn_sign: 1.0,
            forward_sign: 1.0,
            joints: [1, 1],
            joint_ratios: [1.0, 1.0],
        },
        outward: None,
    }
}

/// A drive with a base that sends it messages without a network.
struct BaseRig {
    clock: Arc<ManualClock>,
    drive: Ros2Drive,
    bus: Bus,
    sequence: i64,
    number: u64,
}

/// Content of a message of the base; the fields of [`GOOD`] are valid.
#[derive(Clone, Copy)]
struct BaseMessage {
    joints: [f64; 2],
    frame: &'static str,
    stamp_behind_ns: i64,
    gid: [u8; 16],
    has_attachment: bool,
    is_hashed: bool,
    cut: usize,
    covariance: f64,
    orientation: Quaternion,
    gravity_m_s2: f64,
}

const GOOD: BaseMessage = BaseMessage {
    joints: [8.0, 10.0],
    frame: "imu_link",
    stamp_behind_ns: 2_000_000,
    gid: [1; 16],
    has_attachment: true,
    is_hashed: true,
    cut: 0,
    covariance: 1.0e-4,
    orientation: YAW_ONLY,
    gravity_m_s2: GRAVITY_M_S2,
};

/// A heading of 0.3 rad without any tilt, as of a driver that knows none.
const YAW_ONLY: Quaternion = Quaternion {
    x: 0.0,
    y: 0.0,
    z: 0.149_438_132_473_599_22,
    w: 0.988_771_077_936_042_4,
};

impl BaseRig {
    fn new() -> Self {
        let clock = Arc::new(ManualClock::new(Timestamp::UNIX_EPOCH));
        clock.advance(Duration::from_secs(100));
        let shared: SharedClock = Arc::<ManualClock>::clone(&clock);
        let (drive, bus) = Ros2Drive::new(settings(), &shared).unwrap();
        Self {
            clock,
            drive,
            bus,
            sequence: 0,
            number: 0,
        }
    }

    fn put(&mut self, source: Source, said: &BaseMessage, bytes: &[u8]) {
        self.sequence += 1;
        let attachment = Attachment {
            sequence: self.sequence,
            source_time_ns: self.clock.host_wall_ns() - said.stamp_behind_ns,
            gid: said.gid,
        };
        let attachment = attachment.to_bytes();
        let receiver = self
            .bus
            .receivers
            .iter()
            .find(|receiver| receiver.source() == source);
        let receiver = receiver.unwrap();
        let generation = if said.is_hashed {
            Generation::Hashed
        } else {
            Generation::Humble
        };
        let key = topic_key(
            0,
            receiver.topic().unwrap(),
            &receiver.message_type(),
            generation,
        );
        let attachment = said.has_attachment.then_some(attachment.as_slice());
        receiver.take(&key, attachment, &bytes[..bytes.len() - said.cut]);
    }

    /// Lets a period pass, in which the base says this.
    fn say(&mut self, said: &BaseMessage) -> Feedback {
        self.clock.advance(STEP);
        let stamp_ns = self.clock.host_wall_ns() - said.stamp_behind_ns;
        let header = |frame_id| Header {
            stamp: Time::from_nanoseconds(stamp_ns),
            frame_id,
        };
        let mut bytes = Vec::new();
        let turn = Vector3 {
            z: 0.2,
            ..Vector3::default()
        };
        let imu = Imu {
            header: header(said.frame),
            orientation: said.orientation,
            angular_velocity: turn,
            angular_velocity_covariance: [said.covariance; 9],
            linear_acceleration: Vector3 {
                x: 0.5,
                y: 0.0,
                z: said.gravity_m_s2,
            },
            ..Imu::default()
        };
        encode(&imu, &mut bytes);
        self.put(Source::Imu, said, &bytes);
        let joints = JointState {
            header: header(""),
            name: Sequence::from(&NAMES),
            position: Sequence::default(),
            velocity: Sequence::from(&said.joints),
            effort: Sequence::from(&[1.0, 2.0]),
        };
        encode(&joints, &mut bytes);
        self.put(Source::Joints, said, &bytes);
        self.drive.read(self.clock.monotonic())
    }

    /// Lets a period pass in silence.
    fn pass(&mut self) {
        self.clock.advance(STEP);
        self.drive.read(self.clock.monotonic());
    }

    /// Commands the base; what is sent to it.
    fn command(&mut self, command: WheelSpeeds) -> WheelSpeeds {
        self.drive.write(command);
        let (number, command) = self.drive.command_cell.newer_than(self.number).unwrap();
        self.number = number;
        command
    }
}

#[test]
fn a_good_message_is_a_whole_sample_by_its_stamp() {
    let mut rig = BaseRig::new();
    let feedback = rig.say(&GOOD);
    let [sample] = feedback.samples() else {
        panic!("{feedback:?}");
    };
    let age = rig.clock.monotonic().abs_diff(sample.at);
    assert!(
        age.abs_diff(Duration::from_millis(2)) < Duration::from_micros(1),
        "{age:?}"
    );
    let wheels = sample.wheel_speeds.unwrap();
    assert!(
        (wheels.left_rad_s - 4.0).abs() < 1.0e-12 && (wheels.right_rad_s - 5.0).abs() < 1.0e-12
    );
    let torques = sample.wheel_torques.unwrap();
    assert!((torques.left_n_m - 1.0).abs() < 1.0e-12 && (torques.right_n_m - 2.0).abs() < 1.0e-12);
    let felt = sample.acceleration.unwrap();
    assert!((felt.forward_m_s2 - 0.5).abs() < 1.0e-9 && felt.left_m_s2.abs() < 1.0e-9);
    assert!((sample.yaw_rate_rad_s.unwrap() - 0.2).abs() < 1.0e-12);
    assert!(sample.tilt_rad.unwrap() < 1.0e-6);
    assert_eq!(rig.drive.noise().gyro_rad_s, Some(0.01));
}

#[test]
fn an_acceleration_is_without_gravity_only_if_an_attitude_says_how_much_that_is() {
    let leaning = Quaternion {
        x: 0.0,
        y: 0.05,
        z: 0.0,
        w: (1.0_f64 - 0.05 * 0.05).sqrt(),
    };
    let sample = |orientation: Quaternion, gravity_m_s2: f64| {
        let feedback = BaseRig::new().say(&BaseMessage {
            orientation,
            gravity_m_s2,
            ..GOOD
        });
        feedback.samples()[0]
    };
    assert!(!sample(leaning, GRAVITY_M_S2).is_specific_force);
    assert!(sample(YAW_ONLY, GRAVITY_M_S2).is_specific_force);
    // Four zeros are no orientation.
    let unknown = sample(Quaternion::default(), GRAVITY_M_S2);
    assert!(unknown.is_specific_force && unknown.tilt_rad.is_none());
    assert!((unknown.acceleration.unwrap().forward_m_s2 - 0.5).abs() < 1.0e-9);
    // A simulation without gravity.
    assert!(!sample(Quaternion::default(), 0.0).is_specific_force);
}

#[test]
fn every_bad_message_is_counted_by_its_reason_and_is_no_word_of_the_base() {
    let cases = [
        (
            Refusal::WrongHash,
            BaseMessage {
                is_hashed: false,
                ..GOOD
            },
        ),
        (
            Refusal::NoAttachment,
            BaseMessage {
                has_attachment: false,
                ..GOOD
            },
        ),
        (Refusal::Malformed, BaseMessage { cut: 9, ..GOOD }),
        (
            Refusal::WrongFrame,
            BaseMessage {
                frame: "camera",
                ..GOOD
            },
        ),
        (
            Refusal::Value,
            BaseMessage {
                joints: [f64::NAN, 1.0],
                ..GOOD
            },
        ),
        (
            Refusal::Value,
            BaseMessage {
                joints: [1.0e6, 1.0],
                ..GOOD
            },
        ),
        (
            Refusal::Covariance,
            BaseMessage {
                covariance: -0.5,
                ..GOOD
            },
        ),
        (
            Refusal::Covariance,
            BaseMessage {
                covariance: f64::NAN,
                ..GOOD
            },
        ),
        (
            Refusal::Covariance,
            BaseMessage {
                covariance: 1.0e9,
                ..GOOD
            },
        ),
        (
            Refusal::Late,
            BaseMessage {
                stamp_behind_ns: 500_000_000,
                ..GOOD
            },
        ),
        (
            Refusal::Stamp,
            BaseMessage {
                stamp_behind_ns: -60_000_000_000,
                ..GOOD
            },
        ),
        (
            Refusal::SecondWriter,
            BaseMessage {
                gid: [2; 16],
                ..GOOD
            },
        ),
    ];
    for (refusal, bad) in cases {
        let mut rig = BaseRig::new();
        for _ in 0..5 {
            rig.say(&GOOD);
            assert_eq!(rig.command(COMMANDED), COMMANDED);
        }
        let counts = rig.drive.counts();
        for _ in 0..12 {
            rig.say(&bad);
            rig.command(COMMANDED);
        }
        let count = |source| counts.dropped(source, refusal);
        let dropped = count(Source::Imu) + count(Source::Joints);
        assert!(dropped >= 12, "{refusal:?}");
        let commanded = rig.command(COMMANDED);
        assert_eq!(commanded, WheelSpeeds::default(), "{refusal:?}");
    }
}

#[test]
fn the_frame_for_which_messages_are_dropped_is_named_with_the_configured_one() {
    let mut rig = BaseRig::new();
    let counts = rig.drive.counts();
    let mut drop_monitor = DropMonitor::default();
    for _ in 0..3 {
        rig.say(&BaseMessage {
            frame: "camera",
            ..GOOD
        });
    }
    let (refusal, text) = drop_monitor.check(&counts).unwrap();
    assert_eq!(refusal, Refusal::WrongFrame);
    assert_eq!(
        text,
        "messages of another frame are dropped (imu, 3 so far): frame `camera` instead of `imu_link`"
    );
}

#[test]
fn a_silent_base_rests_in_time_and_hears_nothing_until_the_loop_has_come_to_rest() {
    let mut rig = BaseRig::new();
    assert_eq!(
        rig.command(COMMANDED),
        WheelSpeeds::default(),
        "it has not been heard yet"
    );
    rig.say(&GOOD);
    rig.command(WheelSpeeds::default());
    assert_eq!(rig.command(COMMANDED), COMMANDED);
    let heard_at = rig.clock.monotonic();
    while rig.command(COMMANDED) == COMMANDED {
        rig.pass();
    }
    let silence = rig.clock.monotonic().saturating_sub(heard_at);
    assert!(silence <= Duration::from_millis(110), "{silence:?}");
    rig.say(&GOOD);
    assert_eq!(
        rig.command(COMMANDED),
        WheelSpeeds::default(),
        "the command must not leap"
    );
    rig.command(WheelSpeeds::default());
    assert_eq!(rig.command(COMMANDED), COMMANDED);
}

#[test]
fn a_base_that_starts_again_under_its_identifier_is_heard_and_old_messages_are_not() {
    let mut rig = BaseRig::new();
    for _ in 0..300 {
        assert!(!rig.say(&GOOD).samples().is_empty());
    }
    let counts = rig.drive.counts();
    let restarts = || counts.noted(Source::Joints, Notice::Restarted);
    // It falls silent, and what it said three seconds ago is said again, as it was.
    for _ in 0..50 {
        rig.pass();
    }
    let old = BaseMessage {
        stamp_behind_ns: 3_500_000_000,
        ..GOOD
    };
    rig.sequence = 0;
    for _ in 0..100 {
        assert!(rig.say(&old).samples().is_empty());
    }
    assert_eq!(restarts(), 0);
    // It starts again, with the first number.
    rig.sequence = 0;
    let silent = (0..10).take_while(|_| rig.say(&GOOD).samples().is_empty());
    let silent = u32::try_from(silent.count()).unwrap();
    assert!(silent < super::writer_watch::AGREE_MIN, "{silent} messages");
    assert_eq!(restarts(), 1);
    assert!(!rig.say(&GOOD).samples().is_empty());
}

#[test]
fn wheels_that_do_not_follow_their_command_are_not_believed() {
    let mut rig = BaseRig::new();
    let stuck = BaseMessage {
        joints: [0.0, 0.0],
        ..GOOD
    };
    rig.say(&GOOD);
    let began = rig.clock.monotonic();
    while rig.command(COMMANDED) == COMMANDED {
        rig.say(&stuck);
        assert!(rig.clock.monotonic() < began + Duration::from_secs(2));
    }
    assert!(
        rig.drive
            .counts()
            .dropped(Source::Joints, Refusal::Disobedient)
            > 0
    );
}

#[test]
fn a_base_that_another_node_commands_too_rests_until_that_ceases() {
    let mut rig = BaseRig::new();
    for _ in 0..5 {
        rig.say(&GOOD);
        assert_eq!(rig.command(COMMANDED), COMMANDED);
    }
    let counts = rig.drive.counts();
    let rest = WheelSpeeds::default();
    let mut ticks = 0;
    while rig.command(COMMANDED) == COMMANDED {
        counts.count_foreign_command();
        rig.say(&GOOD);
        ticks += 1;
        assert!(ticks < 20, "it is driven on");
    }
    for _ in 0..100 {
        counts.count_foreign_command();
        rig.say(&GOOD);
        assert_eq!(rig.command(rest), rest);
    }
    assert!(counts.dropped(Source::Joints, Refusal::Contested) > 100);
    // The other falls silent.
    for _ in 0..60 {
        rig.say(&GOOD);
        rig.command(rest);
    }
    assert_eq!(rig.command(COMMANDED), COMMANDED);
}

#[test]
fn more_than_the_loop_takes_is_counted_and_the_newest_is_not_waited_for() {
    let mut rig = BaseRig::new();
    let joints = JointState {
        name: Sequence::from(&NAMES),
        velocity: Sequence::from(&[1.0, 1.0]),
        ..JointState::default()
    };
    for _ in 0..2 * WAITING_MAX {
        rig.clock.advance(Duration::from_millis(1));
        let stamp = Time::from_nanoseconds(rig.clock.host_wall_ns());
        let header = Header {
            stamp,
            frame_id: "",
        };
        let mut bytes = Vec::new();
        encode(&JointState { header, ..joints }, &mut bytes);
        rig.put(Source::Joints, &GOOD, &bytes);
    }
    let overflow = rig
        .drive
        .counts()
        .dropped(Source::Joints, Refusal::Overflow);
    assert_eq!(overflow, u64::try_from(WAITING_MAX).unwrap());
    let feedback = rig.drive.read(rig.clock.monotonic());
    assert!(feedback.lost() > 0);
}
