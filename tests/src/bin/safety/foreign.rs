//! Drive commands that a robot must not take, over real zenoh to a real agent, between those that
//! it must.

use std::time::Duration;

use anyhow::Context;
use tread_agent::RunningAgent;
use tread_api::geometry::Twist;
use tread_api::ids::BootId;
use tread_api::keys::{self, Verb};
use tread_api::safety::{DRIVE_AHEAD_MAX_US, DriveCounts, Driver};
use tread_api::wire;
use tread_api::wire::reply::{Answer, LeaseReply};
use tread_api::wire::safety::{AcquireLease, DriveCommand};
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::{ask, open_session};
use tread_tests::random::Random;
use tread_tests::report::{Check, figure};
use uuid::Uuid;
use zenoh::Session;
use zenoh::qos::CongestionControl;

use crate::Arguments;
use crate::robots::{name, start};

/// The robot's number, apart from all others.
const NUMBER: u32 = 900;
/// Commands that are sent before the robot is given time to read them.
const BURST: u64 = 50;
/// That time.
const BREATH: Duration = Duration::from_millis(4);
/// How long the last commands may take to arrive.
const SETTLE: Duration = Duration::from_millis(500);
/// Kinds of commands that must not be taken.
const KINDS: u64 = 8;
/// More tries than this for each command wanted are not made.
const TRIES_MAX: u64 = 4;

fn below(random: &mut Random, end: u64) -> u64 {
    random.next_u64() % end.max(1)
}

fn refused(counts: DriveCounts) -> u64 {
    counts.malformed + counts.foreign + counts.out_of_order + counts.expired
}

fn counts(agent: &RunningAgent) -> DriveCounts {
    let drive = agent.state().safety.drive;
    drive.map_or_else(DriveCounts::default, |drive| drive.counts)
}

async fn lease(session: &Session, fleet: &Fleet, take: bool) -> anyhow::Result<(BootId, u64)> {
    let command = AcquireLease {
        request: Uuid::new_v4(),
        take,
        holder: Driver {
            client: Uuid::new_v4(),
            name: "safety".to_owned(),
        },
    };
    let key = keys::command(&fleet.site(), &name(NUMBER)?, Verb::Lease);
    let answer: Answer<LeaseReply> = ask(session, &key, &command).await?;
    let LeaseReply::Leased { epoch } = answer.reply else {
        anyhow::bail!("the robot gives no lease: {:?}", answer.reply);
    };
    Ok((answer.boot, epoch))
}

/// A command like the right one, with one thing wrong.
fn wrong(random: &mut Random, right: DriveCommand, old_epoch: u64) -> anyhow::Result<Vec<u8>> {
    let (epoch, seq, now_us) = (right.epoch, right.seq, right.sent_us);
    let wrong = DriveCommand {
        // Above all that were taken, so that only one thing is wrong.
        seq: seq + 1,
        // What is right asks for rest: one that is wrong and taken would be seen.
        twist: Twist {
            linear_m_s: 0.8,
            angular_rad_s: 0.5,
        },
        ..right
    };
    let stranger = BootId::from_uuid(Uuid::new_v4());
    let too_far = DRIVE_AHEAD_MAX_US * (2 + below(random, 1_000));
    let wrong = match below(random, KINDS) {
        0 => DriveCommand {
            boot: stranger,
            ..wrong
        },
        1 => DriveCommand {
            epoch: old_epoch,
            ..wrong
        },
        2 => DriveCommand {
            epoch: epoch + 1,
            ..wrong
        },
        3 => DriveCommand {
            seq: below(random, seq) + 1,
            ..wrong
        },
        4 => DriveCommand {
            until_us: below(random, now_us),
            ..wrong
        },
        5 => DriveCommand {
            until_us: now_us + too_far,
            ..wrong
        },
        6 => {
            let text = String::from_utf8(wire::encode(&wrong)?)?;
            return Ok(text.replace("0.8", "NaN").into_bytes());
        }
        _ => return Ok(vec![b'{'; 1 + usize::try_from(below(random, 4_000))?]),
    };
    Ok(wire::encode(&wrong)?)
}

pub(crate) async fn measure(arguments: &Arguments, fleet: &Fleet) -> anyhow::Result<Vec<Check>> {
    let folder = tempfile::tempdir()?;
    let agent = start(NUMBER, &fleet.zenoh_endpoint(), folder.path())?;
    fleet.robot_is_online(&name(NUMBER)?).await;
    let session = open_session(&fleet.zenoh_endpoint()).await?;
    let (boot, old_epoch) = lease(&session, fleet, false).await?;
    let (_, epoch) = lease(&session, fleet, true).await?;
    anyhow::ensure!(epoch > old_epoch, "the epoch did not rise");
    let publisher = session
        .declare_publisher(keys::teleop(&fleet.site(), &name(NUMBER)?))
        .congestion_control(CongestionControl::Block)
        .await
        .map_err(|error| anyhow::anyhow!("zenoh: {error}"))?;
    let mut random = Random::new(arguments.seed);
    let (mut seq, mut good, mut bad) = (0, 0, 0);
    let most = arguments.foreign * TRIES_MAX;
    while refused(counts(&agent)) < arguments.foreign && bad < most {
        let now_us = agent
            .state()
            .monotonic_us
            .context("an agent says its time")?;
        seq += 1;
        let right = DriveCommand {
            boot,
            epoch,
            seq,
            sent_us: now_us,
            until_us: now_us + 300_000,
            twist: Twist::default(),
        };
        put(&publisher, wire::encode(&right)?).await?;
        good += 1;
        for _ in 0..BURST {
            put(&publisher, wrong(&mut random, right, old_epoch)?).await?;
            bad += 1;
        }
        tokio::time::sleep(BREATH).await;
    }
    tokio::time::sleep(SETTLE).await;
    let state = agent.state();
    let counts = counts(&agent);
    let moved = state
        .twist
        .map_or(0.0, |twist| twist.value.linear_m_s.abs());
    agent.stop().await;
    Ok(vec![
        Check::of("foreign: refused over zenoh", figure(refused(counts)))
            .at_least(figure(arguments.foreign)),
        Check::of(
            "foreign: accepted beyond those that were right",
            figure(counts.accepted.saturating_sub(good)),
        )
        .at_most(0.0),
        Check::of(
            "foreign: right ones accepted, share",
            figure(counts.accepted) / figure(good),
        )
        .at_least(0.9),
        Check::of("foreign: speed of the robot, m/s", moved).at_most(0.05),
    ])
}

async fn put(publisher: &zenoh::pubsub::Publisher<'_>, payload: Vec<u8>) -> anyhow::Result<()> {
    let put = publisher.put(payload).await;
    put.map_err(|error| anyhow::anyhow!("cannot publish: {error}"))
}
