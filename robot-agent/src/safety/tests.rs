//! Everything that may only slow the robot down, on the whole loop with the simulated base.

use std::time::Duration;

use jiff::Timestamp;
use tread_api::geometry::{Point, Polygon, Twist as WireTwist};
use tread_api::ids::{MissionId, StopId};
use tread_api::robot::{PauseCause, RobotMode};
use tread_api::safety::{Driver, Geofence};
use tread_api::wire;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::reply::{CommandRefusal, CommandRefusalCode};
use tread_api::wire::safety::{AcquireLease, DriveCommand, ExternalLimit, Stop};
use tread_control::fence::disc_radius_m;
use tread_control::follower::FailureReason;
use tread_control::gate::GateCause;
use tread_control::gate::teleoperation::BLIND_MAX_M_S;
use tread_control::geometry::Pose;
use tread_control::robot::RobotModel;
use uuid::Uuid;

use crate::control_loop::channels::EndReason;
use crate::sim::drive::COMMAND_TIMEOUT;
use crate::sim::scenario::Scenario;
use crate::testing::{Bench, boot, site_of};

const START: Pose = Pose {
    x_m: 4.0,
    y_m: 3.0,
    heading_rad: 0.0,
};
const LINE: &str = r#"{"waypoints":{"speed_m_s":0.8,
    "points":[{"x_m":4,"y_m":3},{"x_m":8,"y_m":3.2},{"x_m":11,"y_m":4.5}]}}"#;
const SECOND: Duration = Duration::from_secs(1);

fn bench_in(geofence: Geofence) -> Bench {
    let scenario = Scenario::built_in().unwrap();
    let mut bench = Bench::new(&scenario, START, 5).unwrap();
    let mut site = site_of(&scenario).unwrap();
    site.geofence = geofence;
    bench.send_site(site).unwrap();
    bench.run_for(SECOND);
    bench
}

fn driving() -> (Bench, MissionId) {
    let mut bench = bench_in(Geofence::default());
    let line = serde_json::from_str(LINE).unwrap();
    let mission = bench.begin(1, &line, None).unwrap();
    bench.run_for(3 * SECOND);
    assert!(speed_m_s(&bench) > 0.4);
    (bench, mission)
}

fn speed_m_s(bench: &Bench) -> f64 {
    bench.drive.truth().twist().linear_m_s.abs()
}

fn stop(number: u128) -> Stop {
    Stop {
        stop: StopId::from_uuid(Uuid::from_u128(number)),
        by: "an operator".to_owned(),
        reason: "a person on the way".to_owned(),
        at: Timestamp::UNIX_EPOCH,
    }
}

fn mode(bench: &Bench) -> RobotMode {
    bench.ends.shared.snapshot().mode
}

fn cause(bench: &Bench) -> Option<GateCause> {
    bench.ends.shared.snapshot().gate.cause
}

fn paused_by(bench: &Bench) -> Option<PauseCause> {
    bench.ends.shared.snapshot().mission.unwrap().paused_by
}

fn clear(bench: &Bench) {
    // The disk is for other tests: the state alone is what the loop sees.
    let mut stops = super::lock(&bench.safety.stops);
    let id = stops.state.latch().unwrap().id;
    stops.state = stops.state.cleared(id).unwrap().unwrap();
    bench
        .safety
        .cell
        .stop
        .store(0, std::sync::atomic::Ordering::Release);
}

fn until_standing(bench: &mut Bench) {
    let until = bench.now + 5 * SECOND;
    while !bench.is_standing() {
        bench.tick();
        assert!(bench.now < until, "it did not come to stand");
    }
}

fn acquire(bench: &Bench, request: u128, who: u128) -> Result<u64, CommandRefusal> {
    bench.lease(&AcquireLease {
        request: Uuid::from_u128(request),
        holder: Driver {
            client: Uuid::from_u128(who),
            name: format!("driver {who}"),
        },
        take: false,
    })
}

pub(super) struct Teleoperator {
    epoch: u64,
    seq: u64,
}

impl Teleoperator {
    pub(super) fn acquire(bench: &Bench) -> Self {
        let epoch = acquire(bench, 1, 1).unwrap();
        Self { epoch, seq: 0 }
    }

    /// Drives for a while, with a command every 50 ms.
    pub(super) fn drive(
        &mut self,
        bench: &mut Bench,
        linear_m_s: f64,
        angular_rad_s: f64,
        time: Duration,
    ) {
        self.drive_with_age(bench, linear_m_s, angular_rad_s, time, 10_000);
    }

    fn drive_with_age(
        &mut self,
        bench: &mut Bench,
        linear_m_s: f64,
        angular_rad_s: f64,
        time: Duration,
        age_us: u64,
    ) {
        let until = bench.now + time;
        while bench.now < until {
            self.say(bench, linear_m_s, angular_rad_s, age_us);
            bench.run_for(Duration::from_millis(50));
        }
    }

    /// One command.
    pub(super) fn say(
        &mut self,
        bench: &mut Bench,
        linear_m_s: f64,
        angular_rad_s: f64,
        age_us: u64,
    ) {
        self.say_for(bench, linear_m_s, angular_rad_s, age_us, 300_000);
    }

    /// One command that lasts so long.
    fn say_for(
        &mut self,
        bench: &mut Bench,
        linear_m_s: f64,
        angular_rad_s: f64,
        age_us: u64,
        for_us: u64,
    ) {
        self.seq += 1;
        let command = DriveCommand {
            boot: boot(),
            epoch: self.epoch,
            seq: self.seq,
            sent_us: bench.now_us() - age_us,
            until_us: bench.now_us() + for_us,
            twist: WireTwist {
                linear_m_s,
                angular_rad_s,
            },
        };
        assert!(bench.teleoperate(&wire::encode(&command).unwrap()));
    }
}

pub(super) fn limit(bench: &Bench, seq: u64, for_us: u64, hold: bool, linear_max_m_s: Option<f64>) {
    let limit = ExternalLimit {
        owner: "lidar".parse().unwrap(),
        boot: boot(),
        until_us: bench.now_us() + for_us,
        seq,
        hold,
        linear_max_m_s,
    };
    bench.safety.limit(&limit).unwrap();
}

#[test]
fn a_stop_zeroes_the_target_in_the_next_tick_and_nothing_starts_by_itself_after_its_clear() {
    let (mut bench, mission) = driving();
    let number = bench.safety.stop_now(&stop(1));
    bench.tick();
    assert!(bench.target_rests());
    assert_eq!(cause(&bench), Some(GateCause::Stop));
    let zeroed = bench
        .safety
        .cell
        .zeroed
        .load(std::sync::atomic::Ordering::Acquire);
    assert_eq!(zeroed, number);
    assert_eq!(mode(&bench), RobotMode::Stopped);
    until_standing(&mut bench);
    bench.run_for(SECOND);
    assert_eq!(paused_by(&bench), Some(PauseCause::Stop));
    assert_eq!(bench.phase_changes, [MissionPhase::Paused]);
    // It had to brake first; the stop's own time is what is reported.
    let paused_for = bench.paused_for.unwrap();
    assert!(paused_for.as_millis() >= 100, "{paused_for:?}");
    assert!(paused_for.as_secs() < 5, "{paused_for:?}");
    // Asking for it to go on changes nothing while the stop is in force.
    bench.pause(mission, false).unwrap();
    bench.run_for(SECOND);
    assert!(bench.is_standing() && paused_by(&bench) == Some(PauseCause::Stop));
    clear(&bench);
    bench.run_for(3 * SECOND);
    assert!(bench.is_standing(), "it moved by itself after the clear");
    assert_eq!(mode(&bench), RobotMode::Tracking);
    bench.pause(mission, false).unwrap();
    bench.run_for(30 * SECOND);
    assert_eq!(bench.end_of(mission), Some(MissionPhase::Succeeded));
}

#[test]
fn a_stop_counts_while_the_base_is_silent_and_is_still_there_afterwards() {
    let (mut bench, _) = driving();
    for _ in 0..40 {
        bench.tick_without_base();
    }
    assert_eq!(mode(&bench), RobotMode::Fault);
    bench.safety.stop_now(&stop(1));
    bench.tick_without_base();
    assert_eq!(cause(&bench), Some(GateCause::Stop));
    assert_eq!(mode(&bench), RobotMode::Stopped);
    bench.run_for(2 * SECOND);
    assert!(bench.is_standing() && mode(&bench) == RobotMode::Stopped);
}

#[test]
fn the_operator_watchdog_stops_a_robot_whose_driver_is_silent() {
    let (mut bench, mission) = driving();
    let mut teleoperator = Teleoperator::acquire(&bench);
    teleoperator.drive(&mut bench, 0.0, 0.0, 3 * SECOND);
    assert_eq!(mode(&bench), RobotMode::Teleoperated);
    assert_eq!(paused_by(&bench), Some(PauseCause::Teleoperation));
    assert!(bench.is_standing());
    teleoperator.drive(&mut bench, 0.5, 0.0, 2 * SECOND);
    assert!((speed_m_s(&bench) - 0.5).abs() < 0.05);
    let silent_at = bench.now;
    while !bench.target_rests() {
        bench.tick();
    }
    assert!(bench.now <= silent_at + Duration::from_millis(310));
    assert_eq!(cause(&bench), Some(GateCause::Lease));
    until_standing(&mut bench);
    bench.run_for(6 * SECOND);
    assert_ne!(
        mode(&bench),
        RobotMode::Teleoperated,
        "the lease frees itself"
    );
    bench.run_for(3 * SECOND);
    assert!(bench.is_standing() && bench.end_of(mission).is_none());
    let off_m = bench.ends.shared.snapshot().off_path_m.unwrap();
    assert!(off_m > 0.5, "it was driven away from its path by {off_m} m");
}

#[test]
fn a_teleoperator_stays_within_limits_and_ramps() {
    let mut bench = bench_in(Geofence::default());
    let mut teleoperator = Teleoperator::acquire(&bench);
    let mut fastest_m_s2: f64 = 0.0;
    for _ in 0..60 {
        let before_m_s = speed_m_s(&bench);
        teleoperator.drive(&mut bench, 9.0, 0.0, Duration::from_millis(50));
        fastest_m_s2 = fastest_m_s2.max((speed_m_s(&bench) - before_m_s) / 0.05);
    }
    assert!(speed_m_s(&bench) < 1.05);
    assert!(fastest_m_s2 < 1.0, "sped up by {fastest_m_s2} m/s²");
    let counts = bench.safety.drive_status().unwrap().counts;
    assert_eq!(counts.over_limit, counts.accepted);
    // Teleoperated and stopped: a stop needs no lease, and teleoperation no longer counts.
    bench.safety.stop_now(&stop(1));
    teleoperator.drive(&mut bench, 0.5, 0.0, 3 * SECOND);
    assert!(bench.is_standing());
    assert_eq!(cause(&bench), Some(GateCause::Stop));
}

#[test]
fn late_commands_slow_the_robot_down() {
    let mut bench = bench_in(Geofence::default());
    let mut teleoperator = Teleoperator::acquire(&bench);
    teleoperator.drive_with_age(&mut bench, 1.0, 0.0, 3 * SECOND, 400_000);
    assert!(speed_m_s(&bench) < 0.5, "{} m/s", speed_m_s(&bench));
    assert_eq!(cause(&bench), Some(GateCause::CommandAge));
}

#[test]
fn a_limit_from_outside_slows_a_mission_a_hold_holds_it_and_both_end() {
    let (mut bench, mission) = driving();
    limit(&bench, 1, 1_500_000, false, Some(0.2));
    bench.run_for(SECOND + SECOND / 4);
    assert!(speed_m_s(&bench) < 0.22, "{} m/s", speed_m_s(&bench));
    limit(&bench, 2, 3_000_000, true, None);
    until_standing(&mut bench);
    bench.run_for(SECOND / 2);
    assert_eq!(mode(&bench), RobotMode::Tracking);
    assert_eq!(paused_by(&bench), None, "it is held, not paused");
    bench.run_for(30 * SECOND);
    assert_eq!(bench.end_of(mission), Some(MissionPhase::Succeeded));
}

#[test]
fn a_robot_that_leans_too_far_or_says_nonsense_stops() {
    let (mut bench, _) = driving();
    bench.drive.lean(0.6);
    bench.run_for(2 * SECOND);
    assert!(bench.is_standing());
    assert_eq!(cause(&bench), Some(GateCause::Tilt));

    let (mut bench, _) = driving();
    for _ in 0..21 {
        bench.tick_with_nonsense();
    }
    assert!(bench.target_rests());
    assert_eq!(cause(&bench), Some(GateCause::StaleFeedback));
    assert_eq!(mode(&bench), RobotMode::Fault);
}

#[test]
fn a_mission_brakes_before_a_fence_that_was_drawn_across_its_path() {
    let (mut bench, mission) = driving();
    let corners = [(9.0, 2.0), (10.0, 2.0), (10.0, 6.0), (9.0, 6.0)];
    let corners = corners.map(|(x_m, y_m)| Point { x_m, y_m });
    let mut site = site_of(&Scenario::built_in().unwrap()).unwrap();
    site.geofence = Geofence {
        revision: 7,
        keep_in: Vec::new(),
        keep_out: vec![Polygon::new(corners.to_vec()).unwrap()],
    };
    assert!(bench.drive.truth().pose.x_m < 7.6, "too late for this test");
    bench.send_site(site).unwrap();
    bench.run_for(10 * SECOND);
    let x_m = bench.drive.truth().pose.x_m;
    let radius_m = disc_radius_m(&RobotModel::yi2007());
    assert!(x_m < 9.0 - radius_m, "at {x_m} m");
    assert_eq!(cause(&bench), Some(GateCause::Fence));
    bench.run_for(30 * SECOND);
    assert_eq!(bench.end_of(mission), Some(MissionPhase::Failed));
}

fn yard() -> Geofence {
    let corners = |low: f64, high: f64| {
        let corners = [(low, low), (high, low), (high, high), (low, high)];
        let corners = corners.map(|(x_m, y_m)| Point { x_m, y_m });
        Polygon::new(corners.to_vec()).unwrap()
    };
    Geofence {
        revision: 4,
        keep_in: vec![corners(0.0, 10.0)],
        keep_out: vec![corners(6.0, 7.0)],
    }
}

#[test]
fn a_teleoperator_cannot_drive_through_a_fence() {
    for (linear_m_s, angular_rad_s) in [(1.0, 0.0), (-1.0, 0.0), (0.8, 0.3), (1.0, -0.15)] {
        let mut bench = bench_in(yard());
        assert_eq!(bench.ends.shared.snapshot().fence_revision, Some(4));
        let mut teleoperator = Teleoperator::acquire(&bench);
        let fence = crate::geometry::fence_of(&yard());
        let mut least_m = f64::INFINITY;
        for _ in 0..400 {
            teleoperator.drive(
                &mut bench,
                linear_m_s,
                angular_rad_s,
                Duration::from_millis(50),
            );
            let at = bench.drive.truth().pose.point();
            least_m = least_m.min(fence.clearance_m(at));
        }
        let radius_m = disc_radius_m(&RobotModel::yi2007());
        assert!(
            least_m > radius_m,
            "came within {least_m} m with {linear_m_s} {angular_rad_s}"
        );
        assert!(least_m < radius_m + 0.4, "it never came near: {least_m} m");
    }
}

/// Teleoperates for two seconds with nothing that says where the robot is; the fastest speed.
fn driven_blind(bench: &mut Bench) -> f64 {
    let mut teleoperator = Teleoperator::acquire(bench);
    let mut fastest_m_s: f64 = 0.0;
    for tick in 0..200 {
        if tick % 5 == 0 {
            teleoperator.say(bench, 0.8, 0.0, 10_000);
        }
        bench.tick_without_position();
        fastest_m_s = fastest_m_s.max(speed_m_s(bench));
    }
    fastest_m_s
}

fn lost_in(geofence: Geofence) -> Bench {
    let mut bench = bench_in(geofence);
    for _ in 0..400 {
        bench.tick_without_position();
    }
    assert_eq!(mode(&bench), RobotMode::Fault);
    bench
}

#[test]
fn a_robot_without_a_position_is_teleoperated_slowly_and_within_a_fence_only_if_it_may() {
    let mut bench = lost_in(Geofence::default());
    let fastest_m_s = driven_blind(&mut bench);
    assert!(
        (0.2..BLIND_MAX_M_S + 0.02).contains(&fastest_m_s),
        "{fastest_m_s}"
    );
    assert_eq!(cause(&bench), Some(GateCause::StalePosition));

    let mut bench = lost_in(yard());
    assert!(driven_blind(&mut bench) < 0.01);
    assert_eq!(cause(&bench), Some(GateCause::StalePosition));

    let mut bench = lost_in(yard());
    bench.core = bench.core.with_blind_within_fence(true);
    let fastest_m_s = driven_blind(&mut bench);
    assert!(
        (0.2..BLIND_MAX_M_S + 0.02).contains(&fastest_m_s),
        "{fastest_m_s}"
    );
}

#[test]
fn a_robot_that_never_knew_where_it_is_is_teleoperated_slowly() {
    let scenario = Scenario::built_in().unwrap();
    let mut bench = Bench::new(&scenario, START, 5).unwrap();
    for _ in 0..100 {
        bench.tick_without_position();
    }
    let fastest_m_s = driven_blind(&mut bench);
    assert!(
        (0.2..BLIND_MAX_M_S + 0.02).contains(&fastest_m_s),
        "{fastest_m_s}"
    );
}

#[test]
fn the_localisation_watchdog_stops_a_mission_without_a_position_for_three_seconds() {
    let (mut bench, mission) = driving();
    let mut ticks = 0;
    while !bench.target_rests() {
        bench.tick_without_position();
        ticks += 1;
        assert!(ticks <= 301, "it drives on without a position");
    }
    assert!(ticks > 250, "it stopped after {ticks} ticks");
    assert_eq!(mode(&bench), RobotMode::Fault);
    assert_eq!(
        bench.ended,
        [(mission, EndReason::Failed(FailureReason::PoseLost))]
    );
}

#[test]
fn a_command_that_is_about_to_end_does_not_speed_the_robot_up() {
    let mut bench = bench_in(Geofence::default());
    let mut teleoperator = Teleoperator::acquire(&bench);
    for _ in 0..40 {
        teleoperator.say_for(&mut bench, 0.8, 0.0, 10_000, 90_000);
        bench.run_for(Duration::from_millis(50));
    }
    assert!(bench.is_standing(), "{} m/s", speed_m_s(&bench));
    // The same with commands that last longer.
    teleoperator.drive(&mut bench, 0.8, 0.0, SECOND);
    assert!(speed_m_s(&bench) > 0.5);
    // What drives already goes on as it is.
    for _ in 0..20 {
        teleoperator.say_for(&mut bench, 0.8, 0.0, 10_000, 90_000);
        bench.run_for(Duration::from_millis(50));
    }
    assert!(speed_m_s(&bench) > 0.4, "{} m/s", speed_m_s(&bench));
}

#[test]
fn a_base_without_commands_stops_its_wheels() {
    let (mut bench, _) = driving();
    // The agent is gone: nobody reads, nobody writes.
    let gone_at = bench.now;
    while speed_m_s(&bench) > 0.02 {
        bench.simulate();
        assert!(bench.now < gone_at + 2 * SECOND, "it rolls on");
    }
    assert!(bench.now > gone_at + COMMAND_TIMEOUT);
}

#[test]
fn a_refusal_of_a_lease_names_who_has_it() {
    let bench = bench_in(Geofence::default());
    let _teleoperator = Teleoperator::acquire(&bench);
    let refusal = acquire(&bench, 2, 2).unwrap_err();
    assert_eq!(refusal.code, CommandRefusalCode::Leased);
    assert!(refusal.detail.contains("driver 1"), "{refusal:?}");
}

#[test]
fn commands_that_do_not_parse_are_counted_and_change_nothing() {
    let mut bench = bench_in(Geofence::default());
    let _teleoperator = Teleoperator::acquire(&bench);
    let long = vec![b' '; 5_000];
    for bad in [&b""[..], b"{}", b"\xff", &long] {
        assert!(!bench.teleoperate(bad));
    }
    bench.run_for(SECOND);
    let counts = bench.safety.drive_status().unwrap().counts;
    assert_eq!((counts.malformed, counts.accepted), (4, 0));
    assert!(bench.is_standing());
}
