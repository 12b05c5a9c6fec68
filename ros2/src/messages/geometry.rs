//! `geometry_msgs`.

use super::common::Header;
use super::{message, record};

record! {
    /// A direction and its length.
    Vector3 {
        /// Forward.
        x: f64,
        /// To the left.
        y: f64,
        /// Up.
        z: f64,
    }
}

record! {
    /// A place, metres.
    Point {
        /// Forward.
        x: f64,
        /// To the left.
        y: f64,
        /// Up.
        z: f64,
    }
}

record! {
    /// A rotation. The default is none: four zeros, as in ROS 1; [`Quaternion::yaw`] makes one.
    Quaternion {
        /// About x, times the sine of half the angle.
        x: f64,
        /// About y.
        y: f64,
        /// About z.
        z: f64,
        /// The cosine of half the angle.
        w: f64,
    }
}

/// How far the length of a rotation may be from one.
const LENGTH_TOLERANCE: f64 = 0.05;

impl Quaternion {
    /// A turn about z, radians.
    pub fn yaw(yaw_rad: f64) -> Self {
        let (z, w) = (0.5 * yaw_rad).sin_cos();
        Self {
            x: 0.0,
            y: 0.0,
            z,
            w,
        }
    }

    /// The same of length one; none where it is no rotation at all.
    fn unit(self) -> Option<Self> {
        let Self { x, y, z, w } = self;
        let length = (x * x + y * y + z * z + w * w).sqrt();
        // What is no number is no length either.
        let is_rotation = (length - 1.0).abs() <= LENGTH_TOLERANCE;
        is_rotation.then(|| Self {
            x: x / length,
            y: y / length,
            z: z / length,
            w: w / length,
        })
    }

    /// The turn about z, radians, within ±π; none for what is no rotation.
    pub fn yaw_rad(self) -> Option<f64> {
        let Self { x, y, z, w } = self.unit()?;
        Some((2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z)))
    }

    /// How far z leans from upright, radians, 0 to π; none for what is no rotation.
    pub fn tilt_rad(self) -> Option<f64> {
        let Self { x, y, .. } = self.unit()?;
        Some((1.0 - 2.0 * (x * x + y * y)).clamp(-1.0, 1.0).acos())
    }

    /// Where "up" of the outer frame points in the rotated one, a unit vector.
    pub fn up(self) -> Option<Vector3> {
        let Self { x, y, z, w } = self.unit()?;
        Some(Vector3 {
            x: 2.0 * (x * z - w * y),
            y: 2.0 * (y * z + w * x),
            z: 1.0 - 2.0 * (x * x + y * y),
        })
    }
}

record! {
    /// Where something is and how it stands.
    Pose {
        /// Where.
        position: Point,
        /// How.
        orientation: Quaternion,
    }
}

record! {
    /// A pose with the covariance of x, y, z and of the turns about x, y, z, row by
    /// row.
    PoseWithCovariance {
        /// The pose.
        pose: Pose,
        /// Six by six.
        covariance: [[f64; 6]; 6],
    }
}

record! {
    /// A motion: metres and radians per second.
    Twist {
        /// Along x, y, z.
        linear: Vector3,
        /// About x, y, z.
        angular: Vector3,
    }
}
message!(
    Twist,
    "geometry_msgs",
    "Twist",
    "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
);

record! {
    /// A motion with its covariance, in the order of [`PoseWithCovariance`].
    TwistWithCovariance {
        /// The motion.
        twist: Twist,
        /// Six by six.
        covariance: [[f64; 6]; 6],
    }
}

record! {
    /// A motion at a moment.
    TwistStamped<'a> {
        /// When, in which frame.
        header: Header<'a>,
        /// The motion.
        twist: Twist,
    }
}
message!(
    TwistStamped<'a>,
    "geometry_msgs",
    "TwistStamped",
    "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
);

record! {
    /// A pose at a moment.
    PoseStamped<'a> {
        /// When, in which frame.
        header: Header<'a>,
        /// The pose.
        pose: Pose,
    }
}

record! {
    /// A pose at a moment, with its covariance.
    PoseWithCovarianceStamped<'a> {
        /// When, in which frame.
        header: Header<'a>,
        /// The pose.
        pose: PoseWithCovariance,
    }
}
message!(
    PoseWithCovarianceStamped<'a>,
    "geometry_msgs",
    "PoseWithCovarianceStamped",
    "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_about_z_leans_nowhere_and_gives_its_angle_back() {
        for yaw_rad in [-3.0, -0.5, 0.0, 1.0, 3.1] {
            let turned = Quaternion::yaw(yaw_rad);
            assert!((turned.yaw_rad().unwrap() - yaw_rad).abs() < 1.0e-12);
            assert!(turned.tilt_rad().unwrap() < 1.0e-7);
        }
    }

    #[test]
    fn a_lean_about_x_is_seen_and_up_leans_the_other_way() {
        let (sin, cos) = 0.15_f64.sin_cos();
        let leaning = Quaternion {
            x: sin,
            w: cos,
            ..Quaternion::default()
        };
        assert!((leaning.tilt_rad().unwrap() - 0.3).abs() < 1.0e-12);
        let up = leaning.up().unwrap();
        assert!((up.y - 0.3_f64.sin()).abs() < 1.0e-12 && (up.z - 0.3_f64.cos()).abs() < 1.0e-12);
    }

    #[test]
    fn what_is_no_rotation_gives_no_angle() {
        let none = Quaternion::default();
        assert_eq!((none.yaw_rad(), none.tilt_rad()), (None, None));
        let not_a_number = Quaternion {
            w: f64::NAN,
            ..none
        };
        assert_eq!(not_a_number.yaw_rad(), None);
    }
}
