//! The messages that Tread reads from a robot and writes to it, field by field as ROS 2 defines them.
//!
//! Units and frames are ROS's: SI, x forward, y to the left, z up. Nothing here checks a value: that
//! a number is finite, or a quaternion one, is for whoever uses it.

mod common;
mod diagnostic;
mod geometry;
mod nav;
mod sensor;
pub mod tread;

pub use common::{Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout, Text, Time};
pub use diagnostic::{DiagnosticArray, DiagnosticStatus, KeyValue, Level};
pub use geometry::{
    Point, Pose, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped, Quaternion, Twist,
    TwistStamped, TwistWithCovariance, Vector3,
};
pub use nav::{Odometry, Path};
pub use sensor::{BatteryState, Imu, JointState};

use crate::cdr::Field;

/// The name of a message's type, and the hash of its definition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessageType {
    /// The package.
    pub package: &'static str,
    /// The name within the package.
    pub name: &'static str,
    /// The hash that Iron and later know (REP 2011), with its version.
    pub hash: &'static str,
}

/// A field that is a whole message.
pub trait Message<'a>: Field<'a> {
    /// Its type.
    const TYPE: MessageType;
}

/// Defines records: fields on the wire are in the order in which they stand.
macro_rules! record {
    ($(#[$about:meta])* $name:ident<$life:lifetime> { $($(#[$on:meta])* $field:ident: $kind:ty,)* }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        pub struct $name<$life> { $($(#[$on])* pub $field: $kind,)* }
        record!(@field ($life) $name<$life> { $($field: $kind,)* });
    };
    ($(#[$about:meta])* $name:ident { $($(#[$on:meta])* $field:ident: $kind:ty,)* }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        pub struct $name { $($(#[$on])* pub $field: $kind,)* }
        record!(@field ('a) $name { $($field: $kind,)* });
    };
    (@field ($life:lifetime) $name:ty { $($field:ident: $kind:ty,)* }) => {
        impl<$life> $crate::cdr::Field<$life> for $name {
            const BYTES_MIN: usize = 0 $(+ <$kind as $crate::cdr::Field<$life>>::BYTES_MIN)*;

            fn read(from: &mut $crate::cdr::Reader<$life>) -> Result<Self, $crate::cdr::CdrError> {
                $(let $field = <$kind as $crate::cdr::Field<$life>>::read(from)?;)*
                Ok(Self { $($field,)* })
            }

            fn write(&self, to: &mut $crate::cdr::Writer<'_>) {
                $($crate::cdr::Field::<$life>::write(&self.$field, to);)*
            }
        }
    };
}
use record;

/// Says which records are messages, and of which type.
macro_rules! message {
    ($name:ty, $package:literal, $type:literal, $hash:literal) => {
        impl<'a> $crate::messages::Message<'a> for $name {
            const TYPE: $crate::messages::MessageType = $crate::messages::MessageType {
                package: $package,
                name: $type,
                hash: concat!("RIHS01_", $hash),
            };
        }
    };
}
use message;
