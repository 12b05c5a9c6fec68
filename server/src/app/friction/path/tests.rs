use proptest::prelude::*;

use super::*;

fn point(x_m: f64, y_m: f64) -> Point {
    Point { x_m, y_m }
}

#[test]
fn curvature_is_that_of_the_circle_through_the_points() {
    let on = |angle: f64| point(5.0 * angle.cos(), 5.0 * angle.sin());
    assert!((curvature(&[on(0.0), on(0.1), on(0.3)], 1) - 0.2).abs() < 1e-9);
    let straight = curvature(&[point(0.0, 0.0), point(1.0, 0.0), point(3.0, 0.0)], 1);
    assert!(straight.abs() < 1e-12);
    let back = curvature(&[point(0.0, 0.0), point(1.0, 0.0), point(0.5, 0.0)], 1);
    assert!(back.is_infinite());
}

proptest! {
    #[test]
    fn pieces_cover_the_path_and_each_lies_in_its_cell(
        corners in prop::collection::vec((-50.0_f64..50.0, -50.0_f64..50.0), 2..12),
        cell_m in 0.3_f64..5.0,
    ) {
        let points: Vec<Point> = corners.iter().map(|&(x_m, y_m)| point(x_m, y_m)).collect();
        let grid = Grid { revision: 1, cell_m };
        let length_m = checked_length(&points).unwrap();
        let pieces = cut(&points, &grid).unwrap();
        let sum: f64 = pieces.iter().map(|piece| piece.length_m).sum();
        prop_assert!((sum - length_m).abs() < 1e-6 * length_m);
        prop_assert!(pieces.is_sorted_by(|left, right| left.from_m <= right.from_m));
        for piece in &pieces {
            prop_assert!(piece.length_m <= cell_m * 1.5);
            prop_assert_eq!(grid.cell_at(piece.middle), Some(piece.cell));
        }
    }
}
