//! Definitions of messages in ROS's own notation, as recordings carry them with the messages.
//!
//! A reader that knows none of our types reads them by these.

/// A line between two definitions of one schema.
const RULE: &str =
    "================================================================================\n";

/// Package and name, and the fields.
const DEFINITIONS: [(&str, &str); 25] = [
    (
        "builtin_interfaces/Time",
        "int32 sec\n\
         uint32 nanosec\n",
    ),
    (
        "std_msgs/Header",
        "builtin_interfaces/Time stamp\n\
         string frame_id\n",
    ),
    ("std_msgs/String", "string data\n"),
    (
        "std_msgs/MultiArrayDimension",
        "string label\n\
         uint32 size\n\
         uint32 stride\n",
    ),
    (
        "std_msgs/MultiArrayLayout",
        "std_msgs/MultiArrayDimension[] dim\n\
         uint32 data_offset\n",
    ),
    (
        "std_msgs/Float64MultiArray",
        "std_msgs/MultiArrayLayout layout\n\
         float64[] data\n",
    ),
    (
        "geometry_msgs/Point",
        "float64 x\n\
         float64 y\n\
         float64 z\n",
    ),
    (
        "geometry_msgs/Quaternion",
        "float64 x\n\
         float64 y\n\
         float64 z\n\
         float64 w\n",
    ),
    (
        "geometry_msgs/Vector3",
        "float64 x\n\
         float64 y\n\
         float64 z\n",
    ),
    (
        "geometry_msgs/Pose",
        "geometry_msgs/Point position\n\
         geometry_msgs/Quaternion orientation\n",
    ),
    (
        "geometry_msgs/PoseStamped",
        "std_msgs/Header header\n\
         geometry_msgs/Pose pose\n",
    ),
    (
        "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/Pose pose\n\
         float64[36] covariance\n",
    ),
    (
        "geometry_msgs/PoseWithCovarianceStamped",
        "std_msgs/Header header\n\
         geometry_msgs/PoseWithCovariance pose\n",
    ),
    (
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3 linear\n\
         geometry_msgs/Vector3 angular\n",
    ),
    (
        "geometry_msgs/TwistStamped",
        "std_msgs/Header header\n\
         geometry_msgs/Twist twist\n",
    ),
    (
        "geometry_msgs/TwistWithCovariance",
        "geometry_msgs/Twist twist\n\
         float64[36] covariance\n",
    ),
    (
        "nav_msgs/Odometry",
        "std_msgs/Header header\n\
         string child_frame_id\n\
         geometry_msgs/PoseWithCovariance pose\n\
         geometry_msgs/TwistWithCovariance twist\n",
    ),
    (
        "nav_msgs/Path",
        "std_msgs/Header header\n\
         geometry_msgs/PoseStamped[] poses\n",
    ),
    (
        "sensor_msgs/Imu",
        "std_msgs/Header header\n\
         geometry_msgs/Quaternion orientation\n\
         float64[9] orientation_covariance\n\
         geometry_msgs/Vector3 angular_velocity\n\
         float64[9] angular_velocity_covariance\n\
         geometry_msgs/Vector3 linear_acceleration\n\
         float64[9] linear_acceleration_covariance\n",
    ),
    (
        "sensor_msgs/JointState",
        "std_msgs/Header header\n\
         string[] name\n\
         float64[] position\n\
         float64[] velocity\n\
         float64[] effort\n",
    ),
    (
        "diagnostic_msgs/KeyValue",
        "string key\n\
         string value\n",
    ),
    (
        "diagnostic_msgs/DiagnosticStatus",
        "byte OK=0\n\
         byte WARN=1\n\
         byte ERROR=2\n\
         byte STALE=3\n\
         byte level\n\
         string name\n\
         string message\n\
         string hardware_id\n\
         diagnostic_msgs/KeyValue[] values\n",
    ),
    (
        "diagnostic_msgs/DiagnosticArray",
        "std_msgs/Header header\n\
         diagnostic_msgs/DiagnosticStatus[] status\n",
    ),
    (
        "tread_msgs/LoopSample",
        "uint64 at_ns\n\
         uint32 present\n\
         float64 yaw_rate_rad_s\n\
         float64 forward_m_s2\n\
         float64 left_m_s2\n\
         float64 wheel_left_rad_s\n\
         float64 wheel_right_rad_s\n\
         float64 torque_left_n_m\n\
         float64 torque_right_n_m\n\
         float64 body_speed_m_s\n\
         float64 tilt_rad\n\
         float64 x_m\n\
         float64 y_m\n\
         float64 heading_rad\n\
         float64 position_noise_m\n\
         float64 heading_noise_rad\n",
    ),
    (
        "tread_msgs/LoopTick",
        "uint64 number\n\
         uint64 monotonic_ns\n\
         int64 wall_ns\n\
         uint32 present\n\
         uint32 commands\n\
         uint32 lost_samples\n\
         uint64 stop\n\
         uint64 server_silence_ns\n\
         float64 noise_gyro_rad_s\n\
         float64 noise_accelerometer_m_s2\n\
         float64 noise_body_speed_m_s\n\
         float64 battery_charge_ratio\n\
         float64 battery_voltage_v\n\
         tread_msgs/LoopSample[] samples\n\
         float64 wanted_left_rad_s\n\
         float64 wanted_right_rad_s\n\
         float64 command_left_rad_s\n\
         float64 command_right_rad_s\n\
         float64 x_m\n\
         float64 y_m\n\
         float64 heading_rad\n\
         float64 linear_m_s\n\
         float64 angular_rad_s\n\
         float64 theta_loop\n\
         float64 theta\n\
         float64 theta_std_dev\n\
         float64 driven_m\n\
         float64 cross_track_m\n\
         float64 slip_left_ratio\n\
         float64 slip_right_ratio\n\
         float64 segment_information\n\
         float64 segment_weighted\n\
         uint8 mode\n\
         uint8 fault\n\
         uint8 gate\n\
         uint64 judged_ns\n",
    ),
];

fn fields_of(name: &str) -> Option<&'static str> {
    let found = DEFINITIONS.iter().find(|(known, _)| *known == name);
    found.map(|(_, fields)| *fields)
}

/// The types of other messages that a definition's fields have.
fn used_by(fields: &str) -> impl Iterator<Item = &str> {
    let kinds = fields.lines().filter_map(|line| line.split(' ').next());
    kinds
        .filter(|kind| kind.contains('/'))
        .map(|kind| kind.trim_end_matches("[]"))
}

/// Adds the definitions of what a definition's fields have, each once, what it has behind it.
fn add_used<'a>(fields: &'a str, known: &mut Vec<&'a str>, text: &mut String) -> Option<()> {
    for used in used_by(fields) {
        if known.contains(&used) {
            continue;
        }
        known.push(used);
        let fields = fields_of(used)?;
        text.push_str(RULE);
        text.push_str("MSG: ");
        text.push_str(used);
        text.push('\n');
        text.push_str(fields);
        add_used(fields, known, text)?;
    }
    Some(())
}

/// The schema of a message, with all that it consists of; none for one that is not known here.
///
/// `name` is that of its type with its package, such as `nav_msgs/Path`.
pub fn schema(name: &str) -> Option<String> {
    let fields = fields_of(name)?;
    let mut text = fields.to_owned();
    add_used(fields, &mut Vec::new(), &mut text)?;
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_definition_has_all_that_it_consists_of() {
        for (name, _) in DEFINITIONS {
            assert!(schema(name).is_some(), "{name}");
        }
        assert_eq!(schema("nav_msgs/Nothing"), None);
    }
}
