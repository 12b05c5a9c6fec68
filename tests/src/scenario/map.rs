//! What a fleet's friction map is worth: made by robots that measure, used by robots that arrive.
//!
//! 1. **Learning.** The fleet drives figure-8s on five terrains and a ford, and everything between.
//!    Then the map is held against the truth.
//! 2. **Ice.** The ford freezes. One robot of each model passes twice; after each pass the map of
//!    the ford is looked at again.
//! 3. **Arriving.** New robots come over the ford: on a site that has the map, and the same robots,
//!    with the same noise, on a site where nobody has driven. They take a bend and an end on the
//!    ice, and are stopped in the middle of it.
//!
//! The first is done twice, with robots that measure wheel torque and with robots that do not.

use std::collections::BTreeSet;
use std::time::Duration;

use anyhow::ensure;
use futures_util::future::{join_all, try_join_all};
use tread_agent::sim::scenario::Scenario;
use tread_api::friction::{CellFriction, FusedFriction, StoredSegment, TerrainFriction};
use tread_api::geometry::Point;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{MissionDetail, PriorGain};
use tread_api::robot::Alert;
use tread_api::site::Cell;
use tread_control::geometry::Pose;

use super::judge::{
    MapFigures, Stopping, TerrainEstimate, Tracking, map_figures, stopping, tracking,
};
use super::report::{Arrival, FleetMap, IcePass, Report, Size};
use super::world::{Entry, PACE, World};
use super::yard::{self, FORD, ICE_AFTER_S, Kind, Row};
use crate::random::Random;

/// The site on which the fleet has driven.
const SITE: &str = "yard";
/// The same ground, on which nobody has.
const BLANK: &str = "blank";
/// Pace while robots are stopped from outside: what is commanded in real time must find its place.
const PACE_STOPPING: f64 = 4.0;
/// Speed asked of robots that arrive, m/s.
const ARRIVAL_M_S: f64 = 1.0;
/// Line at which arriving robots are commanded to stop, metres north.
const STOP_LINE_M: f64 = 16.0;
/// Longest wait for them to come there, and to stand, real.
const STOP_WAIT_MAX: Duration = Duration::from_mins(5);

/// Runs the whole of it.
///
/// # Errors
/// Something did not come to its end.
pub async fn run(size: Size) -> anyhow::Result<Report> {
    let (torque, arrivals) = learn_and_arrive(size, true).await?;
    let (without, _) = learn_and_arrive(size, false).await?;
    Ok(Report {
        size,
        learned: vec![torque, without],
        arrivals,
    })
}

/// One fleet: what it makes of the site, and with torque also the ice and who arrives then.
///
/// # Errors
/// Something did not come to its end.
pub async fn learn_and_arrive(
    size: Size,
    torque: bool,
) -> anyhow::Result<(FleetMap, Vec<Arrival>)> {
    let mut random = Random::new(size.seed);
    let home: SiteId = SITE.parse()?;
    let mut scenario = yard::ground(&home)?;
    let mut fleet: Vec<(Kind, Entry)> = Vec::new();
    for (kind, x_m) in Kind::ALL.into_iter().zip([4.0, 20.0]) {
        let row = Row {
            name: "rover",
            kind,
            count: size.robots_per_model,
            first: Point { x_m, y_m: 2.0 },
            has_torque: torque,
        };
        let entries = yard::put(&mut scenario, row, &mut random)?;
        fleet.extend(entries.into_iter().map(|entry| (kind, entry)));
    }
    let bending = put_arrivals(&mut scenario, "late", size, &mut random)?;
    let halting = put_arrivals(&mut scenario, "halt", size, &mut random)?;
    let mut world = World::start(&home).await?;
    world.draw(&scenario).await?;
    let entries: Vec<Entry> = fleet.iter().map(|(_, entry)| entry.clone()).collect();
    world.start_robots(&scenario, &entries).await?;
    let mut learned = learn(&world, &scenario, &fleet, (size, torque)).await?;
    let mut arrivals = Vec::new();
    if torque {
        freeze(&world, &scenario, &fleet, &mut learned).await?;
        world.stop_robots().await;
        arrivals = arrive(&mut world, &scenario, &bending).await?;
        arrivals.extend(stop_on_ice(&mut world, &scenario, &halting).await?);
    }
    world.stop().await?;
    Ok((learned, arrivals))
}

fn put_arrivals(
    scenario: &mut Scenario,
    name: &str,
    size: Size,
    random: &mut Random,
) -> anyhow::Result<Vec<Entry>> {
    let mut entries = Vec::new();
    for (kind, x_m) in Kind::ALL.into_iter().zip([37.0, 40.0]) {
        let row = Row {
            name,
            kind,
            count: size.arrivals_per_model,
            first: Point { x_m, y_m: 3.0 },
            has_torque: true,
        };
        entries.extend(yard::put(scenario, row, random)?);
    }
    Ok(entries)
}

async fn learn(
    world: &World,
    scenario: &Scenario,
    fleet: &[(Kind, Entry)],
    (size, torque): (Size, bool),
) -> anyhow::Result<FleetMap> {
    let began = world.now();
    let mut missions = Vec::new();
    let mut number = 0;
    let mut kind_before = None;
    for (kind, Entry { robot, .. }) in fleet {
        number = if kind_before == Some(*kind) {
            number + 1
        } else {
            0
        };
        kind_before = Some(*kind);
        for path in yard::paths(scenario, *kind, number, size.visits)? {
            missions.push(world.send(&scenario.site, robot, &path).await?);
        }
    }
    let ended = world.succeeded(&missions).await?;
    let now = world.now();
    ensure!(
        now.as_secs_f64() < ICE_AFTER_S,
        "the fleet was still driving when the ford froze, {now:?} after the begin"
    );
    let gains = ended.iter().filter_map(gain_of);
    Ok(FleetMap {
        torque,
        before: figures_of(world, scenario, |_| true).await,
        driven_s: now.saturating_sub(began).as_secs_f64(),
        gains: gains.filter(|gain| gain.cells_compared > 0).collect(),
        false_alarms: surface_alerts(world)
            .await
            .into_iter()
            .map(|alert| format!("{}: {}", alert.about(), alert.text))
            .collect(),
        ice: Vec::new(),
        frozen: MapFigures::default(),
    })
}

fn gain_of(detail: &MissionDetail) -> Option<PriorGain> {
    detail.quality.as_ref()?.prior
}

/// Alerts of the site that the ground is not as the map says.
async fn surface_alerts(world: &World) -> Vec<Alert> {
    let alerts: Vec<Alert> = world.rest.all(&format!("/v1/alerts?site={SITE}")).await;
    let is_surface = |alert: &Alert| alert.code.as_str() == "surface-change";
    alerts.into_iter().filter(is_surface).collect()
}

fn model_of(cell: &CellFriction) -> &'static str {
    let configuration = cell.configuration;
    let mut kinds = Kind::ALL.into_iter();
    let kind = kinds.find(|kind| kind.model().configuration() == configuration);
    kind.map_or("?", Kind::name)
}

/// The cells of the site that a choice takes, and its terrains, against the truth.
async fn figures_of(
    world: &World,
    scenario: &Scenario,
    takes: impl Fn(&CellFriction) -> bool,
) -> MapFigures {
    let base = format!("/v1/sites/{}/friction", scenario.site);
    let cells: Vec<CellFriction> = world.rest.all(&format!("{base}/cells")).await;
    let cells: Vec<_> = cells
        .into_iter()
        .filter(takes)
        .map(|cell| (model_of(&cell), cell))
        .collect();
    let terrains: Vec<TerrainFriction> = world.rest.all(&format!("{base}/terrains")).await;
    let wholes = terrains.into_iter().flat_map(|terrain| {
        let id = terrain.terrain.id.to_string();
        terrain.models.into_iter().filter_map(move |known| {
            let mut kinds = Kind::ALL.into_iter();
            let kind = kinds.find(|kind| kind.model().configuration() == known.configuration)?;
            Some(TerrainEstimate {
                terrain: id.clone(),
                model: kind.name(),
                friction: known.friction?,
            })
        })
    });
    let wholes: Vec<TerrainEstimate> = wholes.collect();
    map_figures(scenario, world.now(), &cells, &wholes)
}

/// Cells of the ford that a mission has measured.
async fn measured_in(world: &World, mission: MissionId) -> BTreeSet<Cell> {
    let path = format!("/v1/sites/{SITE}/segments?terrain={FORD}");
    let segments: Vec<StoredSegment> = world.rest.all(&path).await;
    let mine = segments
        .into_iter()
        .filter(|stored| stored.segment.mission == Some(mission));
    mine.map(|stored| stored.segment.cell).collect()
}

/// The ford freezes; one robot of each model passes twice.
async fn freeze(
    world: &World,
    scenario: &Scenario,
    fleet: &[(Kind, Entry)],
    learned: &mut FleetMap,
) -> anyhow::Result<()> {
    world
        .pass_until(Duration::from_secs_f64(ICE_AFTER_S) + Duration::from_secs(1))
        .await?;
    let frozen_at = world.wall();
    let first_of = |kind: Kind| fleet.iter().find(move |(its, _)| *its == kind);
    let first: Vec<&(Kind, Entry)> = Kind::ALL.into_iter().filter_map(first_of).collect();
    let path = yard::over_the_ford(scenario)?;
    let mut both: Vec<Option<BTreeSet<Cell>>> = vec![None; first.len()];
    let mut passes: Vec<Vec<IcePass>> = vec![Vec::new(); first.len()];
    for _pass in 0..2 {
        let sends = first
            .iter()
            .map(|(_, entry)| world.send(&scenario.site, &entry.robot, &path));
        let missions = try_join_all(sends).await?;
        world.ended(&missions).await?;
        let alerts = surface_alerts(world).await;
        let cells: Vec<CellFriction> = world
            .rest
            .all(&format!("/v1/sites/{SITE}/friction/cells"))
            .await;
        for (index, (kind, entry)) in first.iter().enumerate() {
            let seen = measured_in(world, missions[index]).await;
            let seen = match &both[index] {
                Some(before) => before.intersection(&seen).copied().collect(),
                None => seen,
            };
            let of_pass = cells.iter().filter(|cell| {
                let on = cell.terrain.as_ref().map(|drawn| drawn.id.as_str());
                on == Some(FORD) && model_of(cell) == kind.name() && seen.contains(&cell.cell)
            });
            let old = yard::truth(scenario, Some(FORD), 0.0);
            let new = yard::truth(scenario, Some(FORD), ICE_AFTER_S);
            let mut pass = IcePass {
                model: kind.name(),
                cells: 0,
                shown: 0,
                disputed: 0,
                alert: alerts.iter().any(|alert| {
                    alert.robot.as_ref() == Some(&entry.robot) && alert.raised_at >= frozen_at
                }),
            };
            for cell in of_pass {
                pass.cells += 1;
                let FusedFriction {
                    theta,
                    theta_low_95,
                    ..
                } = cell.friction;
                let is_shown = theta_low_95 > old && theta > (old * new).sqrt();
                pass.shown += u32::from(is_shown);
                pass.disputed += u32::from(cell.friction.disputed);
            }
            passes[index].push(pass);
            both[index] = Some(seen);
        }
    }
    learned.ice = passes
        .into_iter()
        .filter_map(|passes| <[IcePass; 2]>::try_from(passes).ok())
        .collect();
    learned.frozen = figures_of(world, scenario, |cell| {
        let on = cell.terrain.as_ref().map(|drawn| drawn.id.as_str());
        on == Some(FORD) && cell.friction.newest_at >= frozen_at
    })
    .await;
    Ok(())
}

/// The same robots on the site with the map and on the one without.
async fn start_twice(
    world: &mut World,
    scenario: &Scenario,
    entries: &[Entry],
) -> anyhow::Result<[Scenario; 2]> {
    let mut blank = scenario.clone();
    blank.site = BLANK.parse()?;
    world.draw_once(&blank).await?;
    world.start_robots(scenario, entries).await?;
    world.start_robots(&blank, entries).await?;
    Ok([scenario.clone(), blank])
}

/// A path over the ice with a bend, which ends on it.
fn course(
    start: tread_control::geometry::Point,
) -> anyhow::Result<tread_api::trajectory::Trajectory> {
    let (x_m, y_m) = (start.x_m, start.y_m);
    let points = [
        (x_m, y_m),
        (x_m, y_m + 5.0),
        (x_m, y_m + 10.0),
        (x_m, y_m + 13.0),
        (x_m + 0.6, y_m + 14.5),
        (x_m + 2.1, y_m + 15.1),
        (x_m + 4.0, y_m + 15.1),
    ];
    yard::path(&points, ARRIVAL_M_S)
}

fn start_of(scenario: &Scenario, robot: &RobotId) -> anyhow::Result<Pose> {
    let placed = scenario.robot(robot);
    let placed = placed.ok_or_else(|| anyhow::anyhow!("{robot} is nowhere"))?;
    Ok(Pose {
        x_m: placed.x_m,
        y_m: placed.y_m,
        heading_rad: placed.heading_rad,
    })
}

async fn arrive(
    world: &mut World,
    scenario: &Scenario,
    entries: &[Entry],
) -> anyhow::Result<Vec<Arrival>> {
    let sites = start_twice(world, scenario, entries).await?;
    let mut missions = Vec::new();
    for site in &sites {
        for Entry { robot, .. } in entries {
            let path = course(start_of(scenario, robot)?.point())?;
            missions.push(world.send(&site.site, robot, &path).await?);
        }
    }
    // Without the map one may well not come to its end.
    let ended = world.ended(&missions).await?;
    let (with, without) = ended.split_at(entries.len());
    let mut arrivals = Vec::new();
    for (Entry { robot, model }, (with, without)) in entries.iter().zip(with.iter().zip(without)) {
        let start = start_of(scenario, robot)?;
        let path = course(start.point())?;
        let of = |site: &Scenario| -> anyhow::Result<Tracking> {
            let samples = world.trace(&site.site, robot)?.samples();
            tracking(&samples, start, model, &path)
        };
        arrivals.push(Arrival {
            robot: robot.clone(),
            course: Some([of(&sites[0])?, of(&sites[1])?]),
            traction_limit_mu: gain_of(with).map(|gain| gain.traction_limit_mu),
            ends: vec![with.mission.state, without.mission.state],
            stop: None,
        });
    }
    world.stop_robots().await;
    Ok(arrivals)
}

async fn stop_on_ice(
    world: &mut World,
    scenario: &Scenario,
    entries: &[Entry],
) -> anyhow::Result<Vec<Arrival>> {
    let sites = start_twice(world, scenario, entries).await?;
    world.set_pace(PACE_STOPPING);
    for site in &sites {
        for Entry { robot, .. } in entries {
            let start = start_of(scenario, robot)?;
            let path = yard::path(&[(start.x_m, start.y_m), (start.x_m, 22.5)], ARRIVAL_M_S)?;
            world.send(&site.site, robot, &path).await?;
        }
    }
    let world = &*world;
    let stops = sites.iter().flat_map(|site| {
        let site = &site.site;
        entries
            .iter()
            .map(move |entry| stop_one(world, site, &entry.robot))
    });
    let mut found = Vec::new();
    for stop in join_all(stops).await {
        found.push(stop?);
    }
    world.set_pace(PACE);
    let (with, without) = found.split_at(entries.len());
    let pairs = with.iter().zip(without).zip(entries);
    Ok(pairs
        .map(|((with, without), entry)| Arrival {
            robot: entry.robot.clone(),
            course: None,
            traction_limit_mu: None,
            ends: Vec::new(),
            stop: Some([*with, *without]),
        })
        .collect())
}

/// Stops a robot where it passes the line.
async fn stop_one(world: &World, site: &SiteId, robot: &RobotId) -> anyhow::Result<Stopping> {
    let trace = world.trace(site, robot)?;
    let passed = || async { (trace.last()?.state.pose.y_m >= STOP_LINE_M).then_some(()) };
    world
        .until("the robot is on the ice", STOP_WAIT_MAX, passed)
        .await?;
    let stop_requested_at = world.now();
    let path = format!("/v1/sites/{site}/robots/{robot}/stop");
    world
        .rest
        .post(&path, &serde_json::json!({"by": "scenario"}))
        .await;
    let stood = || async { stopping(&trace.samples(), stop_requested_at).ok() };
    world.until("the robot stands", STOP_WAIT_MAX, stood).await
}
