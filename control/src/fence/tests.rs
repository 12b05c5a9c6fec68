//! Fences: a robot within its speed limit never leaves, and distances to polygons are exact.

use std::f64::consts::PI;

use proptest::prelude::*;

use super::speed::{Arc, along_arc};
use super::*;
use crate::geometry::{Pose, Twist};

fn square(x_m: f64, y_m: f64, half_m: f64) -> Vec<Point> {
    [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
        .into_iter()
        .map(|(east, north)| Point {
            x_m: x_m + half_m * east,
            y_m: y_m + half_m * north,
        })
        .collect()
}

fn yard() -> Fence {
    Fence::new(&FenceSpec {
        keep_in: vec![square(0.0, 0.0, 5.0), square(8.0, 0.0, 4.0)],
        keep_out: vec![square(2.0, 2.0, 0.5)],
    })
}

fn within(corners: Vec<Point>) -> Fence {
    Fence::new(&FenceSpec {
        keep_in: vec![corners],
        ..FenceSpec::default()
    })
}

proptest! {
    #[test]
    fn clearance_changes_by_no_more_than_the_distance(
        x_m in -15.0..15.0_f64, y_m in -15.0..15.0_f64,
        dx_m in -2.0..2.0_f64, dy_m in -2.0..2.0_f64,
    ) {
        let fence = yard();
        let here = Point { x_m, y_m };
        let there = Point { x_m: x_m + dx_m, y_m: y_m + dy_m };
        let change_m = (fence.clearance_m(here) - fence.clearance_m(there)).abs();
        prop_assert!(change_m <= here.distance_m(there) + 1.0e-9);
    }

    #[test]
    fn a_robot_that_keeps_to_the_cap_never_leaves_the_fence(
        x_m in -4.0..4.0_f64, y_m in -4.0..4.0_f64, heading_rad in -3.1..3.1_f64,
        twists in prop::collection::vec((-1.0..1.0_f64, -2.0..2.0_f64), 1..12),
        mu in prop_oneof![Just(None), (0.05..0.9_f64).prop_map(Some)],
    ) {
        let (fence, model) = (yard(), RobotModel::yi2007());
        let mut pose = Pose { x_m, y_m, heading_rad };
        let radius_m = disc_radius_m(&model);
        prop_assume!(fence.clearance_m(pose.point()) > radius_m + MARGIN_M);
        let braking = Braking::guaranteed(&model, mu);
        let dt_s = 0.02;
        let mut present = Twist::default();
        // Decisions reach the wheels after this delay.
        let mut delayed = [Twist::default(); 5];
        for (linear_m_s, angular_rad_s) in twists {
            for _ in 0..100 {
                let requested = Twist { linear_m_s, angular_rad_s };
                let input = FenceInput {
                    pose, position_std_dev_m: 0.0, present, requested, mu_lower: mu,
                };
                let most_m_s = fence.limit_speed(&input, &model).speed_max_m_s;
                let share = most_m_s.map_or(1.0, |most_m_s| {
                    (most_m_s / linear_m_s.abs().max(1.0e-9)).min(1.0)
                });
                delayed.rotate_left(1);
                delayed[4] = Twist {
                    linear_m_s: share * linear_m_s, angular_rad_s: share * angular_rad_s,
                };
                // No braking harder than the lower bound of friction allows.
                let target = delayed[0];
                let most = braking.deceleration_m_s2 * dt_s;
                let linear_m_s = present.linear_m_s
                    + (target.linear_m_s - present.linear_m_s).clamp(-most, most);
                let is_braking = linear_m_s.abs() < present.linear_m_s.abs();
                // Braking keeps the curvature, as the gate does.
                let angular_rad_s = if is_braking && present.linear_m_s.abs() > 1.0e-9 {
                    present.angular_rad_s * linear_m_s / present.linear_m_s
                } else {
                    target.angular_rad_s
                };
                present = Twist { linear_m_s, angular_rad_s };
                let curvature_1_m = present.angular_rad_s / present.linear_m_s;
                pose = if present.linear_m_s.abs() > 1.0e-9 {
                    along_arc(pose, Arc { curvature_1_m, distance_m: present.linear_m_s * dt_s })
                } else {
                    Pose { heading_rad: pose.heading_rad + present.angular_rad_s * dt_s, ..pose }
                };
                let left_m = fence.clearance_m(pose.point()) - radius_m;
                prop_assert!(left_m > 0.0, "left by {left_m} at {pose:?}");
            }
        }
    }
}

#[test]
fn a_concave_polygon_is_inside_where_it_is() {
    // A horseshoe that is open to the right.
    let corners = [
        (0.0, 0.0),
        (4.0, 0.0),
        (4.0, 1.0),
        (1.0, 1.0),
        (1.0, 3.0),
        (4.0, 3.0),
        (4.0, 4.0),
        (0.0, 4.0),
    ];
    let corners: Vec<Point> = corners
        .into_iter()
        .map(|(x_m, y_m)| Point { x_m, y_m })
        .collect();
    let mut turned = corners.clone();
    turned.reverse();
    for corners in [corners, turned] {
        let fence = within(corners);
        for (x_m, y_m, clearance_m) in [
            (0.5, 2.0, 0.5),
            (3.0, 0.5, 0.5),
            (3.0, 3.5, 0.5),
            (2.0, 2.0, -1.0),
            (5.0, 0.5, -1.0),
            (-1.0, 2.0, -1.0),
            (0.5, 0.5, 0.5),
        ] {
            let got_m = fence.clearance_m(Point { x_m, y_m });
            assert!(
                (got_m - clearance_m).abs() < 1.0e-12,
                "{x_m} {y_m}: {got_m}"
            );
        }
    }
}

#[test]
fn along_a_fence_is_free_and_towards_it_is_slow() {
    let (fence, model) = (within(square(0.0, 0.0, 5.0)), RobotModel::yi2007());
    let gap_m = disc_radius_m(&model) + MARGIN_M + 0.05;
    let at = |heading_rad: f64| FenceInput {
        pose: Pose {
            x_m: 5.0 - gap_m,
            y_m: 0.0,
            heading_rad,
        },
        position_std_dev_m: 0.0,
        present: Twist::default(),
        requested: Twist {
            linear_m_s: 0.8,
            angular_rad_s: 0.0,
        },
        mu_lower: None,
    };
    let cap = |heading_rad| fence.limit_speed(&at(heading_rad), &model).speed_max_m_s;
    assert!(cap(0.0).unwrap() < 0.2);
    assert!(cap(1.57).is_none_or(|most_m_s| most_m_s > 0.5));
    assert!(cap(PI).is_none_or(|most_m_s| most_m_s > 0.5));
}

#[test]
fn from_outside_only_the_way_back_is_open() {
    let (fence, model) = (yard(), RobotModel::yi2007());
    let at = |heading_rad: f64, linear_m_s: f64| {
        let input = FenceInput {
            pose: Pose {
                x_m: -6.0,
                y_m: 0.0,
                heading_rad,
            },
            position_std_dev_m: 0.0,
            present: Twist::default(),
            requested: Twist {
                linear_m_s,
                angular_rad_s: 0.1,
            },
            mu_lower: None,
        };
        fence.limit_speed(&input, &model).speed_max_m_s
    };
    assert_eq!(at(0.0, 0.5), Some(RETURN_MAX_M_S));
    assert_eq!(at(0.0, -0.5), Some(0.0));
    assert_eq!(at(PI, 0.5), Some(0.0));
    assert_eq!(at(PI, -0.5), Some(RETURN_MAX_M_S));
    assert_eq!(at(PI, 0.0), Some(RETURN_MAX_M_S), "turning is open");
}

#[test]
fn a_path_that_crosses_is_named_by_its_place() {
    let fence = yard();
    let line = |y_m: f64| CentrePath {
        point_at: move |arc_m: f64| Point {
            x_m: arc_m - 4.0,
            y_m,
        },
        length_m: 10.0,
    };
    assert_eq!(fence.first_breach(&line(-1.0), 0.3), None);
    let breach = fence.first_breach(&line(2.0), 0.3).unwrap();
    assert!((breach.point.x_m - 1.2).abs() < 0.05, "{breach:?}");
    assert!((breach.arc_m - 5.2).abs() < 0.05, "{breach:?}");
    let nowhere = CentrePath {
        point_at: |_: f64| Point {
            x_m: f64::NAN,
            y_m: 0.0,
        },
        length_m: 1.0,
    };
    assert!(fence.first_breach(&nowhere, 0.3).is_some());
    assert_eq!(Fence::default().first_breach(&nowhere, 0.3), None);
}

#[test]
fn a_pose_that_is_no_number_stops() {
    let input = FenceInput {
        pose: Pose {
            x_m: f64::NAN,
            ..Pose::default()
        },
        position_std_dev_m: 0.0,
        present: Twist::default(),
        requested: Twist::default(),
        mu_lower: None,
    };
    let verdict = yard().limit_speed(&input, &RobotModel::yi2007());
    assert_eq!(verdict.speed_max_m_s, Some(0.0));
}

#[test]
fn an_overlap_names_the_polygon_and_the_nearest_point_of_its_border() {
    let fence = yard();
    let overlap = |x_m: f64, y_m: f64| fence.overlap(Point { x_m, y_m }, 0.4);
    assert_eq!(overlap(0.0, 0.0), None);
    // The overlap of the two polygons is inside; beyond the end of the second is not.
    assert_eq!(overlap(4.8, 0.0), None);
    let over = overlap(11.9, 0.0).unwrap();
    assert_eq!(over.polygon, FencePolygon::KeepIn(1));
    assert!((over.depth_m - 0.3).abs() < 1.0e-12, "{over:?}");
    assert!((over.border.x_m - 12.0).abs() < 1.0e-12, "{over:?}");
    let over = overlap(2.0, 1.3).unwrap();
    assert_eq!(over.polygon, FencePolygon::KeepOut(0));
    assert!((over.border.y_m - 1.5).abs() < 1.0e-12, "{over:?}");
    assert!(overlap(-20.0, 0.0).unwrap().depth_m > 15.0);
}

#[test]
fn a_fence_without_room_stops_every_way_of_driving() {
    let (fence, model) = (Fence::without_allowed_ground(), RobotModel::yi2007());
    assert!(!fence.is_empty());
    for linear_m_s in [-0.5, 0.5] {
        let input = FenceInput {
            pose: Pose::default(),
            position_std_dev_m: 0.0,
            present: Twist::default(),
            requested: Twist {
                linear_m_s,
                angular_rad_s: 0.3,
            },
            mu_lower: None,
        };
        assert_eq!(fence.limit_speed(&input, &model).speed_max_m_s, Some(0.0));
    }
    let path = CentrePath {
        point_at: |_: f64| Point::default(),
        length_m: 1.0,
    };
    assert!(fence.first_breach(&path, 0.3).is_some());
}
