//! Recordings of other robots, and what the agent's estimator makes of them.
//!
//! ```text
//! recording ─► decode ─► timeline ─► stretches ─► estimate ─► analysis
//! MCAP, rosbag2  CDR      stamps,     passes       the loop's   passes, pairs,
//!                         samples                  own stages   effective track
//! ```
//! * [`recording`]: files, their topics, and their messages in the order of recording.
//! * [`mapping`]: which topics and joints are the robot's.
//! * [`decode`]: messages to values, by the reader that the agent has for a ROS 2 robot.
//! * [`timeline`]: the time of each value, and the samples that the loop takes.
//! * [`stretches`]: parts, passes, and how the robot moved in them.
//! * [`estimate`]: runs the loop's sensing and estimation on samples.
//! * [`reasons`]: why there is no estimate, and which manoeuvre would help.
//! * [`statistics`]: consistency of disjoint passes, and the effective track.
//! * [`robot`]: the robot's model by a configuration of the agent, or by its measures.

pub mod analysis;
pub mod decode;
pub mod estimate;
pub mod mapping;
pub mod reasons;
pub mod recording;
pub mod robot;
pub mod statistics;
pub mod stretches;
pub mod timeline;
