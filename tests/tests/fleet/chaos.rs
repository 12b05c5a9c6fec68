//! A handful of random runs; the program `chaos` does hundreds.

use std::path::Path;

use tread_tests::chaos::run;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_fails_at_random_every_mission_ends_and_both_sides_agree() {
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let reports = tokio::join!(run(node, 15), run(node, 16), run(node, 17));
    for report in [reports.0, reports.1, reports.2] {
        assert!(report.violations.is_empty(), "{report:#?}");
        assert_eq!(report.ends.len(), 3);
    }
}
