//! What ROS 2 robots say, as bytes and names: no I/O, no zenoh, no clock, and no ROS.
//!
//! * [`messages`]: the messages that Tread reads and writes, with their type hashes.
//! * [`cdr`]: how they are written; what is read borrows from the message and allocates nothing.
//! * [`definitions`]: the messages' definitions in ROS's notation.
//! * [`names`]: topics and namespaces.
//! * [`rmw`]: key expressions, attachments and liveliness tokens of `rmw_zenoh_cpp`.
//! * [`bridge`]: key expressions of `zenoh-bridge-ros2dds`.

pub mod bridge;
pub mod cdr;
pub mod definitions;
pub mod messages;
pub mod names;
pub mod rmw;
