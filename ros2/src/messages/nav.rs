//! `nav_msgs`.

use super::common::Header;
use super::geometry::{PoseStamped, PoseWithCovariance, TwistWithCovariance};
use super::{message, record};
use crate::cdr::Sequence;

record! {
    /// Where a base believes to be since it started, and how it moves.
    Odometry<'a> {
        /// When; the frame of the pose.
        header: Header<'a>,
        /// The frame of the motion.
        child_frame_id: &'a str,
        /// Where.
        pose: PoseWithCovariance,
        /// How it moves.
        twist: TwistWithCovariance,
    }
}
message!(
    Odometry<'a>,
    "nav_msgs",
    "Odometry",
    "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
);

record! {
    /// A path.
    Path<'a> {
        /// When, in which frame.
        header: Header<'a>,
        /// One after the other.
        poses: Sequence<'a, PoseStamped<'a>>,
    }
}
message!(
    Path<'a>,
    "nav_msgs",
    "Path",
    "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b"
);
