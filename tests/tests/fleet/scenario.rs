//! Fleets in a simulated time: what the map is worth, and what a wrong one does not do.

use tread_agent::sim::scenario::{Scenario, ScenarioRobot, ScenarioText};
use tread_api::friction::{ModelFriction, StoredSegment, TerrainFriction};
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{MissionDetail, MissionState};
use tread_api::robot::Alert;
use tread_tests::scenario::judge::holds;
use tread_tests::scenario::map;
use tread_tests::scenario::report::{Report, Size};
use tread_tests::scenario::world::{Entry, World};
use tread_tests::scenario::yard::{Kind, path};

/// θ of the only ground.
const THETA: f64 = 0.4;

/// One ground everywhere, and robots side by side at its south: name, stiffness of the tyres.
fn field(robots: &[(&str, f64)]) -> Scenario {
    let text = r#"
site = "field"
cell_m = 1.0
robots = []
[[terrains]]
id = "meadow"
class = "grass"
polygon = [[-40, -40], [40, -40], [40, 40], [-40, 40]]
stiffness = 2.5
"#;
    let mut scenario = Scenario::parse(ScenarioText {
        file: "field",
        text,
    })
    .unwrap();
    for (&(name, stiffness_ratio), seed) in robots.iter().zip(40..) {
        scenario.robots.push(ScenarioRobot {
            id: name.parse().unwrap(),
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
            seed,
            stiffness_ratio,
            wheel_torque: true,
            faults: Vec::new(),
        });
    }
    scenario
}

fn entry(name: &str) -> Entry {
    Entry {
        robot: name.parse().unwrap(),
        model: Kind::Small.model(),
    }
}

/// The same way for all of them: straight, then bends to either side.
async fn drive(world: &World, name: &str) -> MissionDetail {
    let points = [
        (0.0, 0.0),
        (4.0, 0.0),
        (6.5, 1.5),
        (9.0, 0.0),
        (11.5, -1.5),
        (14.0, 0.0),
        (17.0, 0.0),
    ];
    let site: SiteId = "field".parse().unwrap();
    let robot: RobotId = name.parse().unwrap();
    let asked = path(&points, 0.6).unwrap();
    let mission: MissionId = world.send(&site, &robot, &asked).await.unwrap();
    let mut ended = world.ended(&[mission]).await.unwrap();
    assert_eq!(
        ended[0].mission.state,
        MissionState::Succeeded,
        "{ended:#?}"
    );
    ended.remove(0)
}

async fn on_the_map(world: &World) -> ModelFriction {
    let path = "/v1/sites/field/friction/terrains/meadow";
    let mut found: TerrainFriction = world.rest.get(path).await;
    found.models.remove(0)
}

/// θ of a robot's own segments alone.
async fn own_theta(world: &World, name: &str) -> f64 {
    let path = format!("/v1/sites/field/segments?robot={name}");
    let stored: Vec<StoredSegment> = world.rest.all(&path).await;
    let theta = |stored: &StoredSegment| stored.segment.theta;
    let information: f64 = stored.iter().map(|it| theta(it).information).sum();
    let weighted: f64 = stored.iter().map(|it| theta(it).weighted).sum();
    weighted / information
}

async fn surface_alerts(world: &World, name: &str) -> Vec<Alert> {
    let path = format!("/v1/alerts?site=field&robot={name}");
    let mut alerts: Vec<Alert> = world.rest.all(&path).await;
    alerts.retain(|alert| alert.code.as_str() == "surface-change");
    alerts
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_next_robot_starts_with_what_the_one_before_has_measured() {
    let scenario = field(&[("first", 1.0), ("next", 1.0)]);
    let mut world = World::start(&scenario.site).await.unwrap();
    world.draw(&scenario).await.unwrap();
    let entries = [entry("first"), entry("next")];
    world.start_robots(&scenario, &entries).await.unwrap();
    let first = drive(&world, "first").await.quality.unwrap();
    assert_eq!(first.prior, None, "nobody had been there");
    let next = drive(&world, "next").await.quality.unwrap();
    let gain = next.prior.expect("the map knew its path");
    assert!(gain.known_ratio > 0.6, "{gain:?}");
    assert!(gain.known_s > gain.known_alone_s, "{gain:?}");
    assert!(gain.cells_compared >= 5, "{gain:?}");
    assert_eq!(gain.cells_contradicted, 0, "{gain:?}");
    assert!(gain.difference_ratio.unwrap().abs() < 0.1, "{gain:?}");
    assert_eq!(surface_alerts(&world, "next").await, []);
    world.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_map_made_wrong_by_one_robot_leads_no_other_robot_astray() {
    // Worn tyres that slip four times as much make a map that is wrong for everybody else.
    let scenario = field(&[("worn", 0.25), ("sound", 1.0)]);
    let mut world = World::start(&scenario.site).await.unwrap();
    world.draw(&scenario).await.unwrap();
    let entries = [entry("worn"), entry("sound")];
    world.start_robots(&scenario, &entries).await.unwrap();
    drive(&world, "worn").await;
    let wrong = on_the_map(&world).await.friction.unwrap().theta;
    assert!(wrong > 3.0 * THETA, "the map says {wrong}");
    let sound = drive(&world, "sound").await.quality.unwrap();
    let gain = sound.prior.expect("the map had a word");
    assert!(
        gain.known_ratio > 0.7 && gain.cells_contradicted >= 5,
        "{gain:?}"
    );
    let measured = own_theta(&world, "sound").await;
    assert!(
        (measured / THETA - 1.0).abs() < 0.1,
        "it measured {measured}"
    );
    let alerts = surface_alerts(&world, "sound").await;
    assert_eq!(alerts.len(), 1, "{alerts:?}");
    assert!(alerts[0].text.contains("has more friction"), "{alerts:?}");
    // Without the robot that was wrong the map is as if it had never come.
    let path = "/v1/sites/field/robots/worn/withdrawals";
    let body = serde_json::json!({"reason": "worn tyres"});
    world.rest.post(path, &body).await;
    let right = on_the_map(&world).await.friction.unwrap();
    assert!(holds(&right, THETA), "{right:?}");
    world.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_small_fleet_makes_a_true_map_sees_the_ice_and_arrives_safely() {
    let size = Size {
        seed: 7,
        robots_per_model: 2,
        visits: 1,
        arrivals_per_model: 1,
    };
    let (learned, arrivals) = map::learn_and_arrive(size, true).await.unwrap();
    let report = Report {
        size,
        learned: vec![learned],
        arrivals,
    };
    let missed: Vec<_> = report
        .checks()
        .into_iter()
        .filter(|check| !check.holds)
        .collect();
    assert!(missed.is_empty(), "{missed:#?} in {report:#?}");
}
