use proptest::prelude::*;
use tread_agent::drive::ros2::reading::Wheels;
use tread_agent::drive::ros2::settings::{Effort, ImuSettings, PoseSettings, SideJoints};
use tread_control::geometry::Pose;
use tread_ros2::messages::{Header, Point, Pose as PoseMessage, Quaternion, Time, Vector3};
use tread_ros2::names::Name;

use super::*;
use crate::logs::mapping::COVARIANT_POSE;
use crate::logs::mapping::tests::settings;

const NAMES: [&str; 4] = ["fl", "fr", "rl", "rr"];

fn mapping(pose: &'static str) -> Mapping {
    let side = |names: [&str; 2]| SideJoints {
        names: names.map(str::to_owned).to_vec(),
        sign: 1.0,
        effort_sign: 1.0,
    };
    let mut settings = settings();
    settings.joints = Some(JointSettings {
        topic: Name::default(),
        left: side(["fl", "rl"]),
        right: side(["fr", "rr"]),
        gear_ratio: 1.0,
        effort: Effort::None,
    });
    settings.imu = Some(ImuSettings {
        topic: Name::default(),
        frame: String::new(),
        yaw_rad: 0.0,
        is_upside_down: false,
    });
    settings.pose = Some(PoseSettings {
        topic: Name::default(),
        frame: String::new(),
        site_from_map: Pose::default(),
    });
    Mapping {
        joints: Some("/joints".to_owned()),
        imu: Some("/imu".to_owned()),
        odometry: None,
        pose: Some(("/pose".to_owned(), pose)),
        settings,
        notices: Vec::new(),
    }
}

fn take(decoder: &mut Decoder, topic: &str, bytes: &[u8]) -> Option<Content> {
    let message = RawMessage {
        topic,
        logged_ns: 0,
        bytes,
    };
    decoder.take(message).map(|timed| timed.content)
}

fn header(at_ns: i64, frame_id: &str) -> Header<'_> {
    Header {
        stamp: Time::from_nanoseconds(at_ns),
        frame_id,
    }
}

fn joints(at_ns: i64, position: &[f64], velocity: &[f64]) -> Vec<u8> {
    let message = JointState {
        header: header(at_ns, ""),
        name: Sequence::from(&NAMES),
        position: Sequence::from(position),
        velocity: Sequence::from(velocity),
        effort: Sequence::default(),
    };
    let mut bytes = Vec::new();
    encode(&message, &mut bytes);
    bytes
}

fn wheels(content: Option<Content>) -> Option<Wheels> {
    let Some(Content::Wheels(wheels)) = content else {
        return None;
    };
    Some(wheels)
}

fn refusals(decoder: &Decoder) -> Vec<(Source, Refusal, u64)> {
    decoder.refusals.iter().collect()
}

#[test]
fn given_speeds_are_taken_and_missing_ones_are_differentiated() {
    let mut decoder = Decoder::new(&mapping(COVARIANT_POSE), false);
    let given = joints(0, &[0.0; 4], &[1.0, 3.0, 2.0, 4.0]);
    let found = wheels(take(&mut decoder, "/joints", &given)).unwrap();
    assert!((found.speeds.left_rad_s - 1.5).abs() < 1.0e-12);
    assert!((found.speeds.right_rad_s - 3.5).abs() < 1.0e-12);
    // Of a first position nothing follows.
    let first = joints(1_000_000_000, &[1.0, 2.0, 1.0, 2.0], &[]);
    assert_eq!(take(&mut decoder, "/joints", &first), None);
    let second = joints(1_020_000_000, &[1.02, 2.04, 1.04, 2.06], &[]);
    let found = wheels(take(&mut decoder, "/joints", &second)).unwrap();
    assert!((found.speeds.left_rad_s - 1.5).abs() < 1.0e-9, "{found:?}");
    assert!((found.speeds.right_rad_s - 2.5).abs() < 1.0e-9, "{found:?}");
    assert_eq!(refusals(&decoder), []);
    // The same stamp again says nothing, and a wrap of a position is no speed of any wheel.
    assert_eq!(take(&mut decoder, "/joints", &second), None);
    let wrapped = joints(1_040_000_000, &[-5.2, 2.08, 1.08, 2.12], &[]);
    assert_eq!(take(&mut decoder, "/joints", &wrapped), None);
    assert_eq!(
        refusals(&decoder),
        [
            (Source::Joints, Refusal::OutOfOrder, 1),
            (Source::Joints, Refusal::Value, 1)
        ]
    );
    // After a long silence it begins again.
    let late = joints(9_000_000_000, &[3.0; 4], &[]);
    assert_eq!(take(&mut decoder, "/joints", &late), None);
}

#[test]
fn positions_are_differentiated_where_that_is_asked_for() {
    let mut decoder = Decoder::new(&mapping(COVARIANT_POSE), true);
    take(&mut decoder, "/joints", &joints(0, &[0.0; 4], &[9.0; 4]));
    let next = joints(10_000_000, &[0.02; 4], &[9.0; 4]);
    let found = wheels(take(&mut decoder, "/joints", &next)).unwrap();
    assert!((found.speeds.left_rad_s - 2.0).abs() < 1.0e-9, "{found:?}");
}

#[test]
fn a_second_sensor_on_a_topic_is_refused_by_its_frame() {
    let mut decoder = Decoder::new(&mapping(COVARIANT_POSE), false);
    let imu = |frame: &str| {
        let message = Imu {
            header: header(0, frame),
            angular_velocity: Vector3 {
                z: 0.5,
                ..Vector3::default()
            },
            ..Imu::default()
        };
        let mut bytes = Vec::new();
        encode(&message, &mut bytes);
        bytes
    };
    assert!(take(&mut decoder, "/imu", &imu("/imu_link")).is_some());
    assert!(take(&mut decoder, "/imu", &imu("imu_link")).is_some());
    assert_eq!(take(&mut decoder, "/imu", &imu("head")), None);
    assert_eq!(refusals(&decoder), [(Source::Imu, Refusal::WrongFrame, 1)]);
    assert_eq!(take(&mut decoder, "/other", &imu("imu_link")), None);
}

#[test]
fn a_plain_pose_is_one_of_unknown_covariance() {
    let mut decoder = Decoder::new(&mapping(POSE), false);
    let message = PoseStamped {
        header: header(0, "map"),
        pose: PoseMessage {
            position: Point {
                x: 1.0,
                y: -2.0,
                z: 0.0,
            },
            orientation: Quaternion::yaw(0.5),
        },
    };
    let mut bytes = Vec::new();
    encode(&message, &mut bytes);
    let Some(Content::Position(found)) = take(&mut decoder, "/pose", &bytes) else {
        panic!("no position: {:?}", refusals(&decoder));
    };
    assert_eq!(found.noise, None);
    assert!(
        (found.pose.x_m - 1.0).abs() < 1.0e-12 && (found.pose.heading_rad - 0.5).abs() < 1.0e-9
    );
}

proptest! {
    #[test]
    fn no_bytes_make_the_reader_panic(
        bytes in proptest::collection::vec(any::<u8>(), 0..400), cut in 0_usize..200,
        topic in 0_usize..3, is_by_positions in any::<bool>(),
    ) {
        let mut decoder = Decoder::new(&mapping(POSE), is_by_positions);
        let topic = ["/joints", "/imu", "/pose"][topic];
        take(&mut decoder, topic, &bytes);
        // A whole message that is cut or spoilt somewhere.
        let mut spoilt = joints(5, &[0.5; 4], &[0.25; 4]);
        let cut = cut.min(spoilt.len());
        if let (Some(byte), Some(with)) = (spoilt.get_mut(cut), bytes.first()) {
            *byte ^= *with;
        }
        take(&mut decoder, "/joints", &spoilt);
        take(&mut decoder, "/joints", &spoilt[..cut]);
    }
}
