//! The last raw measurement of each robot that the stored sums contain.

/// Step of a robot's watermark, from the key of one raw measurement to that of a later one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WatermarkStep {
    /// Key of the robot.
    pub robot_pk: i64,
    /// The stored watermark; 0 if there is none.
    pub from_pk: i64,
    /// The next watermark.
    pub to_pk: i64,
}
