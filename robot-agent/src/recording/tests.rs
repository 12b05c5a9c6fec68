//! Records on the bench: run again to the bit, changed, torn, thinned out, and on a disk that
//! refuses.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::Duration;

use mcap::Writer;
use mcap::io::MessageReader;
use mcap::records::MessageHeader;
use tempfile::TempDir;
use tread_api::friction::ROBOT_BIAS_RATIO;
use tread_api::ids::OwnerId;
use tread_api::safety::{Driver, Geofence};
use tread_api::wire;
use tread_api::wire::command::{CellPrior, PathPrior};
use tread_api::wire::safety::{AcquireLease, DriveCommand, ExternalLimit, Stop};
use tread_control::geometry::Pose;
use tread_ros2::cdr::{decode, encode};
use tread_ros2::messages::tread::LoopTick;
use uuid::Uuid;

use super::read::ReadError;
use super::replay::{ReplayError, Replayed, replay};
use super::{RunHead, codec, report, topics};
use crate::config::recording::RecordingConfig;
use crate::sim::scenario::Scenario;
use crate::testing::{Bench, boot, site_of};

pub(super) const SECOND: Duration = Duration::from_secs(1);

pub(super) fn config(folder: &Path) -> RecordingConfig {
    RecordingConfig {
        folder: folder.to_owned(),
        file_bytes: 64 << 20,
        files: 16,
    }
}

pub(super) fn bench(config: RecordingConfig) -> Bench {
    let scenario = Scenario::built_in().unwrap();
    let start = Pose {
        x_m: 4.0,
        y_m: 3.0,
        heading_rad: 0.5,
    };
    let mut bench = Bench::new(&scenario, start, 3).unwrap();
    let robot = "rover-1".parse().unwrap();
    bench.record(config, scenario.site.clone(), robot);
    bench.send_site(site_of(&scenario).unwrap()).unwrap();
    bench.run_for(SECOND);
    bench
}

fn drive(bench: &mut Bench, time: Duration) {
    let scenario = Scenario::built_in().unwrap();
    bench
        .begin(1, &scenario.missions[0].trajectory, None)
        .unwrap();
    bench.run_for(time);
}

/// The files of a folder, in no order that means anything.
pub(super) fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    files.reverse();
    files
}

/// A record of a short mission in one file.
pub(super) fn short(folder: &Path) -> PathBuf {
    let mut bench = bench(config(folder));
    drive(&mut bench, 4 * SECOND);
    assert_eq!(bench.end_record(), 0);
    files(folder).remove(0)
}

fn replayed(file: &Path) -> Replayed {
    replay(&[file.to_owned()]).unwrap()
}

/// The same record with messages changed or left out, and without some channels.
fn rewritten(
    file: &Path,
    without: Option<&str>,
    change: impl FnMut(&str, &[u8]) -> Option<Vec<u8>>,
) -> PathBuf {
    rewritten_in(file, None, without, change)
}

/// The same in another encoding of messages, of which only the name is changed here.
fn rewritten_in(
    file: &Path,
    encoding: Option<&str>,
    without: Option<&str>,
    mut change: impl FnMut(&str, &[u8]) -> Option<Vec<u8>>,
) -> PathBuf {
    let path = file.with_extension("changed.mcap");
    let mut writer = Writer::new(File::create(&path).unwrap()).unwrap();
    let mut known = BTreeMap::new();
    for message in MessageReader::new(File::open(file).unwrap()) {
        let message = message.unwrap();
        let channel = &message.channel;
        if without == Some(channel.topic.as_str()) {
            continue;
        }
        let encoding = encoding.unwrap_or(&channel.message_encoding);
        let channel_id = *known.entry(channel.topic.clone()).or_insert_with(|| {
            writer
                .add_channel(0, &channel.topic, encoding, &BTreeMap::new())
                .unwrap()
        });
        let Some(bytes) = change(&channel.topic, &message.data) else {
            continue;
        };
        let header = MessageHeader {
            channel_id,
            sequence: message.sequence,
            log_time: message.log_time,
            publish_time: message.publish_time,
        };
        writer.write_to_known_channel(&header, &bytes).unwrap();
    }
    writer.finish().unwrap();
    path
}

/// The same record with the head changed.
fn with_head(file: &Path, change: impl Fn(&mut RunHead)) -> PathBuf {
    rewritten(file, None, |topic, bytes| {
        if topic != topics::RUN {
            return Some(bytes.to_vec());
        }
        let mut head: RunHead = serde_json::from_str(codec::text_of(bytes).unwrap()).unwrap();
        change(&mut head);
        let mut changed = Vec::new();
        codec::text_message(&serde_json::to_string(&head).unwrap(), &mut changed);
        Some(changed)
    })
}

/// The same record with one tick changed or left out.
fn with_tick(
    file: &Path,
    number: u64,
    change: impl Fn(LoopTick<'_>, &mut Vec<u8>) -> bool,
) -> PathBuf {
    rewritten(file, None, |topic, bytes| {
        if topic != topics::TICK {
            return Some(bytes.to_vec());
        }
        let tick: LoopTick<'_> = decode(bytes).unwrap();
        if tick.number != number {
            return Some(bytes.to_vec());
        }
        let mut changed = Vec::new();
        change(tick, &mut changed).then_some(changed)
    })
}

/// A limit from outside, and a teleoperator under it.
fn teleoperate_under_a_limit(bench: &mut Bench) {
    let lidar: OwnerId = "lidar".parse().unwrap();
    let limit = ExternalLimit {
        boot: boot(),
        owner: lidar,
        seq: 1,
        until_us: bench.now_us() + 3_000_000,
        hold: false,
        linear_max_m_s: Some(0.3),
    };
    bench.safety.limit(&limit).unwrap();
    let lease = bench.lease(&AcquireLease {
        request: Uuid::from_u128(1),
        holder: Driver {
            client: Uuid::from_u128(2),
            name: "a driver".to_owned(),
        },
        take: false,
    });
    let epoch = lease.unwrap();
    for seq in 0..150_u64 {
        let command = DriveCommand {
            boot: boot(),
            epoch,
            seq,
            sent_us: bench.now_us(),
            until_us: bench.now_us() + 200_000,
            twist: tread_api::geometry::Twist {
                linear_m_s: 0.6,
                angular_rad_s: 0.2,
            },
        };
        assert!(bench.teleoperate(&wire::encode(&command).unwrap()));
        bench.tick();
        bench.tick();
    }
}

#[test]
fn a_day_with_all_that_happens_runs_again_to_the_bit() {
    let folder = TempDir::new().unwrap();
    let mut bench = bench(RecordingConfig {
        file_bytes: 60_000,
        files: 100,
        ..config(folder.path())
    });
    bench.set_prior(&PathPrior {
        grid_revision: 1,
        traction_limit_mu: 0.3,
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        cells: (0..40)
            .map(|place| CellPrior {
                cell: tread_api::site::Cell {
                    ix: place % 8,
                    iy: place / 8,
                },
                theta: 0.2 + 0.001 * f64::from(place),
                std_dev: 0.02,
            })
            .collect(),
        traction_limits: Vec::new(),
    });
    drive(&mut bench, 5 * SECOND);
    let mission = bench.starts[0];
    bench.pause(mission, true).unwrap();
    bench.run_for(2 * SECOND);
    bench.pause(mission, false).unwrap();
    bench.run_for(2 * SECOND);
    // Sensors that speak nonsense, a base that is silent, a robot that does not know where it is.
    for _ in 0..20 {
        bench.tick_with_nonsense();
    }
    for _ in 0..40 {
        bench.tick_without_base();
    }
    bench.run_for(2 * SECOND);
    for _ in 0..400 {
        bench.tick_without_position();
    }
    bench.run_for(SECOND);
    teleoperate_under_a_limit(&mut bench);
    let mut site = site_of(&Scenario::built_in().unwrap()).unwrap();
    site.geofence = Geofence {
        revision: 2,
        ..Geofence::default()
    };
    bench.send_site(site).unwrap();
    bench.run_for(SECOND);
    bench.safety.stop_now(&Stop {
        stop: tread_api::ids::StopId::from_uuid(Uuid::from_u128(9)),
        by: "somebody".to_owned(),
        reason: "to see it".to_owned(),
        at: jiff::Timestamp::UNIX_EPOCH,
    });
    bench.run_for(2 * SECOND);
    bench.tick_loop(true);
    bench.collect();
    let ticks = bench.ends.shared.snapshot().ticks;
    assert_eq!(bench.end_record(), 0, "nothing was lost on the way");

    let mut parts = files(folder.path());
    assert!(parts.len() > 3, "{} files", parts.len());
    let found = replay(&parts).unwrap();
    assert!(report::holds(&found), "{}", report::text(&found));
    assert_eq!((found.ticks, found.differing), (ticks, 0));
    assert!(found.driving_ticks > 600, "{}", found.driving_ticks);
    assert_eq!(found.torn, None);

    // Without its first part a run has no beginning, without another one no end.
    let first = parts.pop().unwrap();
    let refused = replay(&parts);
    assert!(matches!(
        refused,
        Err(ReplayError::Read(ReadError::PartMissing {
            expected: 0,
            ..
        }))
    ));
    let begin = replay(&[first]).unwrap();
    assert!(begin.ticks > 0 && begin.ticks < ticks && report::holds(&begin));
}

#[test]
fn a_record_in_which_the_loop_was_late_and_interrupted_runs_again_to_the_bit() {
    let folder = TempDir::new().unwrap();
    let mut bench = bench(config(folder.path()));
    drive(&mut bench, 3 * SECOND);
    bench.pass_time(SECOND / 4);
    bench.run_for(2 * SECOND);
    bench.tick_interrupted(SECOND / 5);
    bench.run_for(3 * SECOND);
    teleoperate_under_a_limit(&mut bench);
    bench.tick_interrupted(SECOND / 5);
    bench.run_for(SECOND);
    assert_eq!(bench.end_record(), 0);
    let found = replayed(&files(folder.path()).remove(0));
    assert!(report::holds(&found), "{}", report::text(&found));
    assert!(found.ticks > 1_000 && found.driving_ticks > 500);
}

#[test]
fn a_record_of_format_1_still_runs_again_to_the_bit() {
    let folder = TempDir::new().unwrap();
    let file = short(folder.path());
    let ticks = replayed(&file).ticks;
    // Its texts were plain JSON, its ticks ended with the gate's cause.
    let earlier = rewritten_in(&file, Some("json"), None, |topic, bytes| {
        Some(match topic {
            topics::RUN => {
                let text = codec::text_of(bytes).unwrap();
                let mut head: RunHead = serde_json::from_str(text).unwrap();
                head.format = 1;
                serde_json::to_vec(&head).unwrap()
            }
            topics::COMMAND | topics::SAFETY => codec::text_of(bytes).unwrap().as_bytes().to_vec(),
            topics::TICK => {
                let tick: LoopTick<'_> = decode(bytes).unwrap();
                bytes[..tick_bytes_in_format_1(&tick)].to_vec()
            }
            _ => bytes.to_vec(),
        })
    });
    let found = replayed(&earlier);
    assert_eq!(found.head.format, 1);
    assert!(report::holds(&found), "{}", report::text(&found));
    assert_eq!(found.ticks, ticks);
}

/// Length of a tick up to the gate's cause: encapsulation, what stands before the samples, these,
/// 18 numbers, and 3 single bytes.
fn tick_bytes_in_format_1(tick: &LoopTick<'_>) -> usize {
    4 + 104 + 128 * tick.samples.len() + 8 * 18 + 3
}

#[test]
fn a_record_with_one_input_changed_by_a_millionth_differs_from_there_on() {
    let folder = TempDir::new().unwrap();
    let file = short(folder.path());
    assert!(report::holds(&replayed(&file)));
    let changed = with_tick(&file, 300, |tick, into| {
        let mut samples: Vec<_> = tick.samples.iter().collect();
        let speed = &mut samples[0].wheel_left_rad_s;
        *speed += 1.0e-6;
        let tick = LoopTick {
            samples: samples.as_slice().into(),
            ..tick
        };
        encode(&tick, into);
        true
    });
    let found = replayed(&changed);
    assert!(!report::holds(&found));
    assert!(
        found.first_differing[0].tick >= 300 && found.first_differing[0].tick < 310,
        "{:?}",
        found.first_differing[0]
    );
    assert!(found.differing > 50, "{}", found.differing);
    let text = report::text(&found);
    assert!(text.contains("ticks differ from the record"), "{text}");
}

#[test]
fn a_changed_output_is_reported_with_both_figures() {
    let folder = TempDir::new().unwrap();
    let file = short(folder.path());
    let changed = with_tick(&file, 250, |tick, into| {
        let tick = LoopTick {
            command_left_rad_s: 77.5,
            ..tick
        };
        encode(&tick, into);
        true
    });
    let found = replayed(&changed);
    assert_eq!((found.differing, found.first_differing[0].tick), (1, 250));
    let [difference] = &found.first_differing[0].differences[..] else {
        panic!("{:?}", found.first_differing[0]);
    };
    assert_eq!(difference.name, "command left, rad/s");
    assert_eq!(difference.recorded.to_bits(), 77.5_f64.to_bits());
    let object = report::object(&found);
    assert_eq!(object["checks"][1]["holds"], false, "{object}");
}

#[test]
fn a_torn_record_is_read_up_to_the_tear_and_no_farther() {
    let folder = TempDir::new().unwrap();
    let file = short(folder.path());
    let whole = replayed(&file).ticks;
    let bytes = fs::read(&file).unwrap();
    let torn = folder.path().join("torn.mcap");
    let mut most = 0;
    for tenths in 1..10 {
        fs::write(&torn, &bytes[..bytes.len() * tenths / 10]).unwrap();
        match replay(std::slice::from_ref(&torn)) {
            Ok(found) => {
                assert!(found.torn.is_some(), "{tenths} tenths");
                assert!(
                    found.ticks < whole && found.ticks >= most,
                    "{tenths} tenths"
                );
                assert_eq!((found.differing, found.gap.as_ref()), (0, None));
                most = found.ticks;
            }
            Err(ReplayError::Read(ReadError::NoRecord(_))) => assert_eq!(most, 0),
            Err(other) => panic!("{other}"),
        }
    }
    assert!(most > 100, "{most} ticks");
    // A byte that is not as it was written is as good as a tear, wherever it counts.
    let mut tears = 0;
    for place in (0..bytes.len()).step_by(bytes.len() / 40) {
        let mut spoilt = bytes.clone();
        spoilt[place] ^= 0x55;
        fs::write(&torn, &spoilt).unwrap();
        let Ok(found) = replay(std::slice::from_ref(&torn)) else {
            continue;
        };
        assert_eq!((found.differing, found.gap.as_ref()), (0, None), "{place}");
        assert!(found.torn.is_some() || found.ticks == whole, "{place}");
        tears += usize::from(found.torn.is_some() && found.ticks < whole);
    }
    assert!(tears > 10, "{tears} of 40 were noticed");
}

#[test]
fn what_cannot_be_run_again_is_refused_in_words_that_say_why() {
    let folder = TempDir::new().unwrap();
    let file = short(folder.path());
    for topic in [topics::TICK, topics::RUN] {
        let changed = rewritten(&file, Some(topic), |_, bytes| Some(bytes.to_vec()));
        let refused = replay(&[changed]).err().unwrap().to_string();
        assert!(
            refused.contains(&format!("has no channel `{topic}`")),
            "{refused}"
        );
    }
    let newer = with_head(&file, |head| {
        head.format = 77;
        head.version = "9.9.9".to_owned();
    });
    let refused = replay(&[newer]).err().unwrap().to_string();
    assert!(
        refused.contains("format 77") && refused.contains("tread-agent 9.9.9"),
        "{refused}"
    );
    let other = with_head(&file, |head| head.version = "0.0.1".to_owned());
    let found = replayed(&other);
    assert!(report::holds(&found) && found.is_of_another_version());
    assert!(report::text(&found).contains("recorded by tread-agent 0.0.1"));
    let nothing = folder.path().join("nothing.mcap");
    fs::write(&nothing, b"no record at all").unwrap();
    let refused = replay(&[nothing]).err().unwrap().to_string();
    assert!(refused.contains("is no MCAP file"), "{refused}");
    let gone = replay(&[folder.path().join("gone.mcap")]).err().unwrap();
    assert!(gone.to_string().contains("cannot be opened"), "{gone}");
}

#[test]
fn nothing_behind_a_gap_is_called_a_difference() {
    let folder = TempDir::new().unwrap();
    let file = short(folder.path());
    let without = with_tick(&file, 200, |_, _| false);
    let found = replayed(&without);
    assert_eq!((found.ticks, found.differing), (199, 0));
    assert!(!report::holds(&found));
    let gap = found.gap.unwrap();
    assert!(gap.contains("ticks 200 to 201"), "{gap}");
    let silent = rewritten(&file, Some(topics::COMMAND), |_, bytes| {
        Some(bytes.to_vec())
    });
    let gap = replayed(&silent).gap.unwrap();
    assert!(
        gap.contains("took 1 commands, of which 0 are in the record"),
        "{gap}"
    );
}

#[test]
fn no_more_files_are_kept_than_may_be_and_others_are_left_alone() {
    let folder = TempDir::new().unwrap();
    let foreign = folder.path().join("notes.txt");
    fs::write(&foreign, "keep me").unwrap();
    let limits = RecordingConfig {
        file_bytes: 20_000,
        files: 3,
        ..config(folder.path())
    };
    let mut bench = bench(limits);
    drive(&mut bench, 10 * SECOND);
    assert_eq!(bench.end_record(), 0);
    let kept = files(folder.path());
    assert_eq!(kept.len(), 4, "{kept:?}");
    assert!(kept.contains(&foreign));
    for file in kept.iter().filter(|file| **file != foreign) {
        let bytes = fs::metadata(file).unwrap().len();
        assert!(bytes < 1_000_000, "{bytes} bytes");
    }
}

#[test]
fn a_disk_that_refuses_costs_the_record_and_not_the_mission() {
    let folder = TempDir::new().unwrap();
    let blocked = folder.path().join("blocked");
    fs::write(&blocked, "a file where the folder would be").unwrap();
    let mut bench = bench(config(&blocked));
    drive(&mut bench, 3 * SECOND);
    assert!(bench.ends.shared.snapshot().mission.is_some());
    // Once it may, it goes on with a file that says that it is not the first.
    fs::remove_file(&blocked).unwrap();
    bench.run_for(12 * SECOND);
    bench.end_record();
    let refused = replay(&files(&blocked)).err().unwrap().to_string();
    assert!(refused.contains("part 0 is missing"), "{refused}");
}
