//! A loop that does not keep its rate holds the robot; on the bench, and on a machine that is busy.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tread_api::geometry::Twist;
use tread_api::robot::RobotMode;
use tread_api::safety::Driver;
use tread_api::wire;
use tread_api::wire::safety::{AcquireLease, DriveCommand, Stop};
use tread_control::gate::GateCause;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;
use uuid::Uuid;

use super::channels::{EndReason, loop_channels};
use super::overrun::{LATE_AFTER, LATE_MAX, Overrun, RELEASE_AFTER};
use super::tests::{LINE, ORIGIN, bench_at, one_ground, site_of};
use super::tick::LoopCore;
use crate::clock::{SharedClock, SystemClock};
use crate::dispatcher::answers;
use crate::drive::{Drive, Feedback};
use crate::safety::stop::StopState;
use crate::safety::{Safety, microseconds};
use crate::sim::drive::{Individual, SimMode, SimulatedDrive};
use crate::testing::{Bench, PERIOD, boot};

const MILLISECOND: Duration = Duration::from_millis(1);

fn bench() -> Bench {
    let scenario = one_ground(2.5);
    let mut bench = bench_at(&scenario, ORIGIN, 1);
    bench.send_site(site_of(&scenario)).unwrap();
    bench.run_for(500 * MILLISECOND);
    bench
}

fn cause(bench: &Bench) -> Option<GateCause> {
    bench.ends.shared.snapshot().gate.cause
}

fn overrun(bench: &Bench) -> Option<Overrun> {
    bench.ends.shared.snapshot().overrun
}

/// A tick that comes late by so much.
fn late_tick(bench: &mut Bench, by: Duration) {
    bench.pass_time(by);
    bench.tick();
}

fn acquire() -> AcquireLease {
    AcquireLease {
        request: Uuid::from_u128(1),
        take: false,
        holder: Driver {
            client: Uuid::from_u128(2),
            name: "a driver".to_owned(),
        },
    }
}

fn command(epoch: u64, seq: u64, now_us: u64, lasting: Duration) -> Vec<u8> {
    let command = DriveCommand {
        boot: boot(),
        epoch,
        seq,
        sent_us: now_us,
        until_us: now_us + microseconds(lasting),
        twist: Twist {
            linear_m_s: 0.6,
            angular_rad_s: 0.0,
        },
    };
    wire::encode(&command).unwrap()
}

#[test]
fn a_late_loop_holds_the_robot_with_its_figures_and_lets_its_mission_go_on_afterwards() {
    let mut bench = bench();
    let mission = bench.start(1, LINE, None);
    bench.run_for(3_000 * MILLISECOND);
    assert!(!bench.is_standing() && cause(&bench) != Some(GateCause::LoopOverrun));
    late_tick(&mut bench, LATE_MAX);
    let snapshot = bench.ends.shared.snapshot();
    assert_eq!(snapshot.gate.cause, Some(GateCause::LoopOverrun));
    assert!(snapshot.gate.target_rests, "in the same tick");
    assert_eq!(overrun(&bench).unwrap().late, LATE_MAX);
    // It brakes on its ramp, stands, and stays until the loop has kept its rate for a while.
    bench.run_for(RELEASE_AFTER.saturating_sub(2 * PERIOD));
    assert!(bench.is_standing());
    assert_eq!(cause(&bench), Some(GateCause::LoopOverrun));
    late_tick(&mut bench, LATE_MAX);
    bench.run_for(RELEASE_AFTER / 2);
    // One that is a little late does not prolong it.
    late_tick(&mut bench, LATE_AFTER + MILLISECOND);
    bench.run_for((RELEASE_AFTER / 2).saturating_sub(LATE_AFTER + 4 * PERIOD));
    assert!(overrun(&bench).is_some(), "far too late once more");
    bench.run_for(4 * PERIOD);
    assert_eq!(overrun(&bench), None);
    // Nobody has to resume the mission.
    while bench.end_of(mission).is_none() {
        bench.tick();
        assert!(bench.now < Duration::from_mins(3), "it did not end");
    }
    assert_eq!(bench.ended.last(), Some(&(mission, EndReason::Reached)));
    let off_m = bench.cross_track_m.unwrap();
    assert!(off_m.abs() < 0.1, "{off_m}");
}

#[test]
fn a_driver_is_held_by_a_late_loop_and_a_stop_is_stricter_than_that() {
    let mut bench = bench();
    let epoch = bench.lease(&acquire()).unwrap();
    let mut seq = 0;
    let mut drive = |bench: &mut Bench, late_by: Duration| {
        seq += 1;
        let payload = command(epoch, seq, bench.now_us(), 400 * MILLISECOND);
        assert!(bench.teleoperate(&payload));
        late_tick(bench, late_by);
    };
    for _ in 0..100 {
        drive(&mut bench, Duration::ZERO);
    }
    assert!(!bench.target_rests());
    for tick in 0..3 {
        assert_eq!(overrun(&bench), None, "tick {tick}");
        drive(&mut bench, LATE_AFTER + MILLISECOND);
    }
    assert!(bench.target_rests(), "three in a row");
    assert_eq!(cause(&bench), Some(GateCause::LoopOverrun));
    assert_eq!(bench.ends.shared.snapshot().mode, RobotMode::Teleoperated);
    bench.safety.stop_now(&Stop {
        stop: tread_api::ids::StopId::from_uuid(Uuid::from_u128(9)),
        by: "an operator".to_owned(),
        reason: "a person on the path".to_owned(),
        at: jiff::Timestamp::UNIX_EPOCH,
    });
    drive(&mut bench, Duration::ZERO);
    assert_eq!(cause(&bench), Some(GateCause::Stop));
    assert!(overrun(&bench).is_some());
}

#[test]
fn a_command_that_ends_while_a_tick_is_interrupted_moves_nothing_any_more() {
    let mut bench = bench();
    let epoch = bench.lease(&acquire()).unwrap();
    for seq in 1..100 {
        let payload = command(epoch, seq, bench.now_us(), 200 * MILLISECOND);
        assert!(bench.teleoperate(&payload));
        bench.tick();
    }
    assert!(!bench.target_rests());
    // The last one has 190 ms left when this tick begins, and none when it comes to the gate.
    bench.tick_interrupted(195 * MILLISECOND);
    assert!(bench.target_rests());
    assert_eq!(cause(&bench), Some(GateCause::Lease));
}

/// Drive that records the begin and the command of each tick.
struct RecordingDrive {
    base: SimulatedDrive,
    began: Duration,
    ticks: Arc<Mutex<Vec<(Duration, WheelSpeeds)>>>,
}

impl Drive for RecordingDrive {
    fn read(&mut self, now: Duration) -> Feedback {
        self.began = now;
        self.base.read(now)
    }

    fn write(&mut self, command: WheelSpeeds) {
        self.base.write(command);
        self.ticks.lock().unwrap().push((self.began, command));
    }
}

/// Threads of a busy machine, for each of its processors.
const BUSY_THREADS: usize = 4;
/// How long it is busy.
const BUSY_FOR: Duration = Duration::from_millis(1_500);

/// How late the loop may be is the machine's matter; that it notices is its own.
#[test]
fn a_loop_on_a_busy_machine_obeys_in_its_next_tick_and_notices_each_late_one() {
    let clock: SharedClock = SystemClock::shared();
    let model = RobotModel::yi2007();
    let (loop_ends, ends) = loop_channels();
    let shared = Arc::clone(&ends.shared);
    let folder = tempfile::tempdir().unwrap();
    let safety = Safety::open(
        folder.path(),
        StopState::default(),
        boot(),
        model,
        &[],
        Arc::clone(&shared.safety),
        Arc::clone(&clock),
    );
    let ticks = Arc::new(Mutex::new(Vec::with_capacity(10_000)));
    let individual = Individual::of_seed(1);
    let scenario = one_ground(2.5);
    let drive = RecordingDrive {
        base: SimulatedDrive::new(&scenario, model, ORIGIN, individual, SimMode::Auto).unwrap(),
        began: Duration::ZERO,
        ticks: Arc::clone(&ticks),
    };
    let core = LoopCore::new(model, loop_ends).with_period(PERIOD);
    let is_busy = AtomicBool::new(true);
    let threads = BUSY_THREADS * std::thread::available_parallelism().map_or(2, usize::from);
    let (mut last_end_us, mut overruns_seen) = (0, 0);
    std::thread::scope(|scope| {
        let for_loop = Arc::clone(&clock);
        scope.spawn(move || super::run(core, Box::new(drive), &for_loop, PERIOD));
        for _ in 0..threads {
            scope.spawn(|| {
                while is_busy.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let epoch = answers::acquire_lease(&safety, &acquire()).unwrap();
        let began = clock.monotonic();
        let mut seq = 0;
        while clock.monotonic() < began + BUSY_FOR {
            seq += 1;
            let now_us = microseconds(clock.monotonic());
            safety.handle_drive(&command(epoch, seq, now_us, 150 * MILLISECOND));
            last_end_us = now_us + 150_000;
            overruns_seen += u32::from(shared.snapshot().overrun.is_some());
            std::thread::sleep(20 * MILLISECOND);
        }
        // The driver is silent; the machine is still busy.
        std::thread::sleep(500 * MILLISECOND);
        is_busy.store(false, Ordering::Relaxed);
        shared.stop.store(true, Ordering::Relaxed);
    });
    let ticks = ticks.lock().unwrap();
    assert!(ticks.len() > 10, "{} ticks", ticks.len());
    let rises = |from: WheelSpeeds, to: WheelSpeeds| {
        to.magnitude_max_rad_s() > from.magnitude_max_rad_s() + 1.0e-9
    };
    let (mut worst, mut late_ticks) = (Duration::ZERO, 0);
    for pair in ticks.windows(2) {
        let [(before, had), (began, has)] = pair else {
            continue;
        };
        let late = began.saturating_sub(*before).saturating_sub(PERIOD);
        worst = worst.max(late);
        late_ticks += u32::from(late > LATE_AFTER);
        // No tick that is far too late, and none after the last command's end, lets the robot gain.
        if late >= LATE_MAX || microseconds(*began) >= last_end_us {
            assert!(!rises(*had, *has), "{late:?} late: {had:?}, {has:?}");
        }
    }
    let ended = ticks
        .iter()
        .find(|(began, _)| microseconds(*began) >= last_end_us);
    assert!(
        ended.is_some(),
        "no tick after the driver's silence: {} ticks, {late_ticks} late, worst {worst:?}, held in \
         {overruns_seen} looks",
        ticks.len()
    );
}
