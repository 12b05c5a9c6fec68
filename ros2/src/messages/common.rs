//! `builtin_interfaces` and `std_msgs`.

use super::{message, record};
use crate::cdr::Sequence;

/// Nanoseconds of a second.
const NANOSECONDS: i64 = 1_000_000_000;

record! {
    /// A moment of the writer's clock, since its epoch.
    Time {
        /// Whole seconds.
        sec: i32,
        /// Nanoseconds within the second.
        nanosec: u32,
    }
}

impl Time {
    /// Nanoseconds since the epoch; none if the fraction is a second or more.
    pub fn nanoseconds(self) -> Option<i64> {
        let fraction = i64::from(self.nanosec);
        (fraction < NANOSECONDS).then(|| i64::from(self.sec) * NANOSECONDS + fraction)
    }

    /// The moment that is so many nanoseconds after the epoch; the ends of what can be written for
    /// what is beyond them.
    pub fn from_nanoseconds(nanoseconds: i64) -> Self {
        let sec = nanoseconds.div_euclid(NANOSECONDS);
        let fraction = nanoseconds.rem_euclid(NANOSECONDS);
        Self {
            sec: i32::try_from(sec).unwrap_or(if sec < 0 { i32::MIN } else { i32::MAX }),
            nanosec: u32::try_from(fraction).unwrap_or_default(),
        }
    }
}

record! {
    /// When and in which frame a message was measured.
    Header<'a> {
        /// When.
        stamp: Time,
        /// In which frame.
        frame_id: &'a str,
    }
}

record! {
    /// One dimension of an array.
    MultiArrayDimension<'a> {
        /// Its name.
        label: &'a str,
        /// Its size, items.
        size: u32,
        /// Items from one step along it to the next.
        stride: u32,
    }
}

record! {
    /// How an array lies in its data.
    MultiArrayLayout<'a> {
        /// From the outermost dimension on.
        dim: Sequence<'a, MultiArrayDimension<'a>>,
        /// Items before the first.
        data_offset: u32,
    }
}

record! {
    /// Numbers: for a velocity controller of `ros2_control`, one for each joint.
    Float64MultiArray<'a> {
        /// How they lie; empty for a plain list.
        layout: MultiArrayLayout<'a>,
        /// The numbers.
        data: Sequence<'a, f64>,
    }
}
message!(
    Float64MultiArray<'a>,
    "std_msgs",
    "Float64MultiArray",
    "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f"
);

record! {
    /// A text: `std_msgs/String`.
    Text<'a> {
        /// The text.
        data: &'a str,
    }
}
message!(
    Text<'a>,
    "std_msgs",
    "String",
    "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_before_the_epoch_convert_and_those_beyond_the_last_are_clamped() {
        let before = Time::from_nanoseconds(-1);
        assert_eq!((before.sec, before.nanosec), (-1, 999_999_999));
        assert_eq!(before.nanoseconds(), Some(-1));
        assert_eq!(Time::from_nanoseconds(i64::MAX).sec, i32::MAX);
        let none = Time {
            sec: 1,
            nanosec: 1_000_000_000,
        };
        assert_eq!(none.nanoseconds(), None);
    }
}
