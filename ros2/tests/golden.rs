//! Every message, byte for byte as `rosbags` writes it; `tests/ros2/golden.py` wrote `golden.json`.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::Deserialize;
use tread_ros2::cdr::{Sequence, decode, encode};
use tread_ros2::definitions::schema;
use tread_ros2::messages::{
    BatteryState, DiagnosticArray, DiagnosticStatus, Float64MultiArray, Header, Imu, JointState,
    KeyValue, Message, MultiArrayDimension, MultiArrayLayout, Odometry, Path, Point, Pose,
    PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped, Quaternion, Text, Time, Twist,
    TwistStamped, TwistWithCovariance, Vector3,
};
use tread_ros2::rmw::{Attachment, gid};

#[derive(Deserialize)]
struct Golden {
    messages: BTreeMap<String, String>,
    hashes: BTreeMap<String, String>,
    definitions: BTreeMap<String, String>,
    token: String,
    attachment: String,
}

fn golden() -> Golden {
    serde_json::from_str(include_str!("golden.json")).expect("the file is the repository's own")
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// The same as `numbers` in golden.py.
fn numbers<const N: usize>(first: f64) -> [f64; N] {
    let mut index = -1.0;
    [(); N].map(|()| {
        index += 1.0;
        first + 0.25 * index
    })
}

/// The same, six by six.
fn rows(first: f64) -> [[f64; 6]; 6] {
    let mut row = -1.0;
    [(); 6].map(|()| {
        row += 1.0;
        numbers(first + 1.5 * row)
    })
}

fn header(frame_id: &str) -> Header<'_> {
    let stamp = Time {
        sec: 1_700_000_000,
        nanosec: 123_456_789,
    };
    Header { stamp, frame_id }
}

fn vector(x: f64, y: f64, z: f64) -> Vector3 {
    Vector3 { x, y, z }
}

const WHEELS: [&str; 4] = ["front_left", "front_right", "rear_left", "rear_right"];

const VOLTS: [f32; 6] = [3.5, 3.75, 4.0, 4.25, 4.5, 4.75];

const DEGREES: [f32; 6] = [23.5, 23.75, 24.0, 24.25, 24.5, 24.75];

const TURNED: Quaternion = Quaternion {
    x: 0.0,
    y: 0.0,
    z: 0.6,
    w: 0.8,
};

const POSE: Pose = Pose {
    position: Point {
        x: 1.5,
        y: -2.25,
        z: 0.125,
    },
    orientation: TURNED,
};

fn covariant_pose() -> PoseWithCovariance {
    PoseWithCovariance {
        pose: POSE,
        covariance: rows(0.5),
    }
}

fn twist() -> Twist {
    Twist {
        linear: vector(0.5, -0.25, 0.0),
        angular: vector(0.0, 0.0, -1.75),
    }
}

/// Compares a message with `rosbags`' bytes, both ways, and strikes it from the list.
fn same<'a, T: Message<'a> + PartialEq + std::fmt::Debug>(
    left: &mut BTreeMap<String, String>,
    name: &str,
    message: T,
) {
    let mut bytes = Vec::new();
    encode(&message, &mut bytes);
    let expected = left.remove(name).expect("each name is there once");
    assert_eq!(hex(&bytes), expected, "{name}");
    let bytes: &'static [u8] = Vec::leak(bytes);
    assert_eq!(decode(bytes), Ok(message), "{name}");
    // The shortest message is no shorter than its type says.
    assert!(bytes.len() >= T::BYTES_MIN, "{name}");
}

#[test]
fn sensors_are_read_and_written_as_by_rosbags() {
    let mut left = golden().messages;
    for (name, frame, child) in [
        ("odometry", "odom", "base_link"),
        ("odometry_of_a_long_frame", "robot7/odom_frame", ""),
    ] {
        let message = Odometry {
            header: header(frame),
            child_frame_id: child,
            pose: covariant_pose(),
            twist: TwistWithCovariance {
                twist: twist(),
                covariance: rows(-4.0),
            },
        };
        same(&mut left, name, message);
    }
    for (name, frame) in [("imu", "imu_link"), ("imu_without_a_frame", "")] {
        let message = Imu {
            header: header(frame),
            orientation: TURNED,
            orientation_covariance: numbers(1.0),
            angular_velocity: vector(0.01, 0.02, -0.5),
            angular_velocity_covariance: numbers(2.0),
            linear_acceleration: vector(0.1, -0.2, 9.81),
            linear_acceleration_covariance: numbers(3.0),
        };
        same(&mut left, name, message);
    }
    for (name, names) in [
        ("joints", WHEELS.as_slice()),
        ("joints_without_names", &[]),
        ("joints_of_odd_names", &["a", "bc", "def"]),
    ] {
        let lists = |first: f64| Vec::leak(numbers::<4>(first)[..names.len()].to_vec());
        let message = JointState {
            header: header("base_link"),
            name: Sequence::from(names),
            position: Sequence::from(&*lists(0.0)),
            velocity: Sequence::from(&*lists(10.0)),
            effort: Sequence::from(&*lists(-1.0)),
        };
        same(&mut left, name, message);
    }
    let message = PoseWithCovarianceStamped {
        header: header("map"),
        pose: covariant_pose(),
    };
    same(&mut left, "pose", message);
    for (name, cells, location) in [("battery", 6, "slot 1"), ("battery_without_cells", 0, "")] {
        let message = BatteryState {
            header: header("battery"),
            voltage: 25.5,
            temperature: 31.25,
            current: -4.75,
            charge: 7.5,
            capacity: 10.0,
            design_capacity: 10.5,
            percentage: 0.75,
            power_supply_status: 2,
            power_supply_health: 1,
            power_supply_technology: 3,
            present: true,
            cell_voltage: Sequence::from(&VOLTS[..cells]),
            cell_temperature: Sequence::from(&DEGREES[..cells]),
            location,
            serial_number: "sn-1",
        };
        same(&mut left, name, message);
    }
}

#[test]
fn commands_and_what_is_published_are_read_and_written_as_by_rosbags() {
    let mut left = golden().messages;
    same(&mut left, "twist", twist());
    let stamped = TwistStamped {
        header: header("base_link"),
        twist: twist(),
    };
    same(&mut left, "stamped_twist", stamped);
    let dimension = [MultiArrayDimension {
        label: "wheels",
        size: 2,
        stride: 4,
    }];
    let data = numbers::<4>(-1.0);
    for (name, dimensions, count) in [
        ("array", 1, 4),
        ("plain_array", 0, 2),
        ("empty_array", 0, 0),
    ] {
        let message = Float64MultiArray {
            layout: MultiArrayLayout {
                dim: Sequence::from(&*Vec::leak(dimension[..dimensions].to_vec())),
                data_offset: 0,
            },
            data: Sequence::from(&*Vec::leak(data[..count].to_vec())),
        };
        same(&mut left, name, message);
    }
    for (name, data) in [
        ("text", "{\"tick\": 7, \"to\": \"hört\"}"),
        ("empty_text", ""),
    ] {
        same(&mut left, name, Text { data });
    }
    let poses = ["", "m", "mm"].map(|frame| PoseStamped {
        header: header(frame),
        pose: POSE,
    });
    for (name, count) in [("path", 3), ("empty_path", 0)] {
        let message = Path {
            header: header("map"),
            poses: Sequence::from(&*Vec::leak(poses[..count].to_vec())),
        };
        same(&mut left, name, message);
    }
    let values = ["", "k", "kk"];
    let figures = |index: usize| {
        let all = values.map(|key| KeyValue {
            key,
            value: ["", "v", "vv", "vvv"][index],
        });
        Sequence::from(&*Vec::leak(all[..index].to_vec()))
    };
    for (name, count) in [("diagnostics", 4_u8), ("empty_diagnostics", 0)] {
        let parts: Vec<_> = (0..count)
            .map(|level| DiagnosticStatus {
                level,
                name: "tread: base",
                message: "hört",
                hardware_id: "rover-1",
                values: figures(usize::from(level)),
            })
            .collect();
        let message = DiagnosticArray {
            header: header(""),
            status: Sequence::from(&*parts.leak()),
        };
        same(&mut left, name, message);
    }
}

#[test]
fn hashes_of_all_types_are_those_of_rosbags() {
    let mut left = golden().hashes;
    let mut check = |of: tread_ros2::messages::MessageType| {
        let hash = left.remove(&format!("{}/msg/{}", of.package, of.name));
        assert_eq!(hash.as_deref(), Some(of.hash), "{}", of.name);
    };
    check(BatteryState::TYPE);
    check(DiagnosticArray::TYPE);
    check(Float64MultiArray::TYPE);
    check(Imu::TYPE);
    check(JointState::TYPE);
    check(Odometry::TYPE);
    check(Path::TYPE);
    check(PoseWithCovarianceStamped::TYPE);
    check(Text::TYPE);
    check(Twist::TYPE);
    check(TwistStamped::TYPE);
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn definitions_in_recordings_are_those_of_rosbags() {
    let golden = golden();
    assert!(golden.definitions.len() > 7);
    for (kind, text) in &golden.definitions {
        let name = kind.replace("/msg/", "/");
        assert_eq!(schema(&name).as_deref(), Some(text.as_str()), "{kind}");
    }
}

#[test]
fn the_attachment_and_the_name_in_it_are_those_of_zenoh_and_xxhash() {
    let golden = golden();
    let attachment = Attachment {
        sequence: 41,
        source_time_ns: 1_700_000_000_123_456_789,
        gid: gid(&golden.token),
    };
    assert_eq!(hex(&attachment.to_bytes()), golden.attachment);
}
