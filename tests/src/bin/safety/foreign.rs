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
use tread_api::wire::command::{Answer, Outcome};
use tread_api::wire::safety::{DriveCommand, LeaseAction, LeaseCommand};
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::{ask, open_session};
use tread_tests::random::Random;
use uuid::Uuid;
use zenoh::Session;
use zenoh::qos::CongestionControl;

use crate::robots::{name, start};
use crate::{Arguments, Check, figure};

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

async fn lease(
    session: &Session,
    fleet: &Fleet,
    action: LeaseAction,
) -> anyhow::Result<(BootId, u64)> {
    let command = LeaseCommand {
        request: Uuid::new_v4(),
        action,
        holder: Driver {
            client: Uuid::new_v4(),
            name: "safety".to_owned(),
        },
    };
    let key = keys::command(&fleet.site(), &name(NUMBER)?, Verb::Lease);
    let answer: Answer = ask(session, &key, &command).await?;
    match answer.outcome {
        Outcome::Leased { epoch } => Ok((answer.boot, epoch)),
        other => anyhow::bail!("the robot gives no lease: {other:?}"),
    }
}

pub(crate) async fn measure(arguments: &Arguments, fleet: &Fleet) -> anyhow::Result<Vec<Check>> {
    let folder = tempfile::tempdir()?;
    let agent = start(NUMBER, &fleet.zenoh_endpoint(), folder.path())?;
    fleet.robot_is_online(&name(NUMBER)?).await;
    let session = open_session(&fleet.zenoh_endpoint()).await?;
    let (boot, old_epoch) = lease(&session, fleet, LeaseAction::Acquire).await?;
    let (_, epoch) = lease(&session, fleet, LeaseAction::Take).await?;
    anyhow::ensure!(epoch > old_epoch, "the epoch did not rise");
    let publisher = session
        .declare_publisher(keys::teleop(&fleet.site(), &name(NUMBER)?))
        .congestion_control(CongestionControl::Block)
        .await
        .map_err(|error| anyhow::anyhow!("zenoh: {error}"))?;
    let mut random = Random::new(arguments.seed);
    let (mut seq, mut good, mut bad) = (0, 0, 0);
    let most = arguments.foreign * TRIES_MAX;
    // What is wrong asks for motion, what is right for rest: one that is taken would be seen.
    let motion = Twist {
        linear_m_s: 0.8,
        angular_rad_s: 0.5,
    };
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
            let wrong = DriveCommand {
                // Above all that were taken, so that only one thing is wrong.
                seq: seq + 1,
                twist: motion,
                ..right
            };
            let payload = match below(&mut random, KINDS) {
                0 => wire::encode(&DriveCommand {
                    boot: BootId::from_uuid(Uuid::new_v4()),
                    ..wrong
                })?,
                1 => wire::encode(&DriveCommand {
                    epoch: old_epoch,
                    ..wrong
                })?,
                2 => wire::encode(&DriveCommand {
                    epoch: epoch + 1,
                    ..wrong
                })?,
                3 => wire::encode(&DriveCommand {
                    seq: below(&mut random, seq) + 1,
                    ..wrong
                })?,
                4 => wire::encode(&DriveCommand {
                    until_us: below(&mut random, now_us),
                    ..wrong
                })?,
                5 => wire::encode(&DriveCommand {
                    until_us: now_us + DRIVE_AHEAD_MAX_US * (2 + below(&mut random, 1_000)),
                    ..wrong
                })?,
                6 => String::from_utf8(wire::encode(&wrong)?)?
                    .replace("0.8", "NaN")
                    .into_bytes(),
                _ => vec![b'{'; 1 + usize::try_from(below(&mut random, 4_000))?],
            };
            put(&publisher, payload).await?;
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
        Check::at_least(
            "foreign: refused over zenoh",
            figure(arguments.foreign),
            figure(refused(counts)),
        ),
        Check::at_most(
            "foreign: accepted beyond those that were right",
            0.0,
            figure(counts.accepted.saturating_sub(good)),
        ),
        Check::at_least(
            "foreign: right ones accepted, share",
            0.9,
            figure(counts.accepted) / figure(good),
        ),
        Check::at_most("foreign: speed of the robot, m/s", 0.05, moved),
    ])
}

async fn put(publisher: &zenoh::pubsub::Publisher<'_>, payload: Vec<u8>) -> anyhow::Result<()> {
    let put = publisher.put(payload).await;
    put.map_err(|error| anyhow::anyhow!("cannot publish: {error}"))
}
