//! What a dry run says before a mission is sent is what its robot plans when the mission's turn
//! comes: over random queues, on ground that the map knows and that limits speeds.

use serde_json::{Value, json};
use tread_agent::sim::scenario::{Scenario, ScenarioRobot, ScenarioText};
use tread_api::geometry::Pose;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::trajectory::{Binding, BindingLimit, Trajectory, TrajectoryCheck};
use tread_tests::random::Random;
use tread_tests::scenario::world::{Entry, World};
use tread_tests::scenario::yard::{Kind, path};

/// Largest difference of lengths and durations, as a share of what the robot planned.
const DIFFERENCE_MAX: f64 = 0.01;
/// Regions, each with a scout and a rover.
const ROBOTS: u32 = 6;
/// Missions of a queue.
const QUEUE: usize = 4;
/// Distance of the regions' centres, metres.
const PITCH_M: f64 = 14.0;
/// Half side of a region, metres.
const REGION_M: f64 = 5.0;
const SITE: &str = "field";
/// Robots that make the map, and robots that drive the queues.
const SCOUT: &str = "scout";
const ROVER: &str = "rover";
const SEED: u64 = 20_261_124;

/// Firm ground in the north, soft ground in the south of every region.
fn field() -> Scenario {
    let text = r#"
site = "field"
cell_m = 1.0
robots = []
[[terrains]]
id = "meadow"
class = "grass"
polygon = [[-20, 0], [120, 0], [120, 20], [-20, 20]]
stiffness = 2.5
[[terrains]]
id = "sand"
class = "sand"
polygon = [[-20, -20], [120, -20], [120, 0], [-20, 0]]
stiffness = 0.7
peak_slip = 0.3
"#;
    let mut scenario = Scenario::parse(ScenarioText {
        file: "field",
        text,
    })
    .unwrap();
    let robots = (0..ROBOTS).flat_map(|number| [(SCOUT, number), (ROVER, number)]);
    for ((kind, number), seed) in robots.zip(70..) {
        scenario.robots.push(ScenarioRobot {
            id: name(kind, number),
            x_m: center_x_m(number),
            y_m: 0.0,
            heading_rad: 0.0,
            seed,
            stiffness_ratio: 1.0,
            wheel_torque: true,
            faults: Vec::new(),
        });
    }
    scenario
}

fn name(kind: &str, number: u32) -> RobotId {
    format!("{kind}-{number}").parse().unwrap()
}

fn center_x_m(number: u32) -> f64 {
    PITCH_M * f64::from(number)
}

/// Takes what the rovers will measure off the map before they do: a plan is made with the map of
/// the moment at which the robot accepts it, and no dry run knows that one.
async fn keep_map_as_it_is(world: &World) {
    for number in 0..ROBOTS {
        let robot = name(ROVER, number);
        let path = format!("/v1/sites/{SITE}/robots/{robot}/withdrawals");
        let hours = json!({
            "from": "2026-11-01T00:00:00Z", "to": "2026-11-01T23:59:59Z", "reason": "it only drives",
        });
        world.rest.post(&path, &hours).await;
    }
}

fn site() -> SiteId {
    SITE.parse().unwrap()
}

/// Bends through both grounds of a region, so that the map knows them.
fn survey(middle_x_m: f64) -> Trajectory {
    let place = |&(x_m, y_m): &(f64, f64)| (middle_x_m + x_m, y_m);
    let points = [
        (0.0, 0.0),
        (2.0, 2.5),
        (4.0, 0.5),
        (3.5, -2.5),
        (0.5, -4.0),
        (-3.0, -2.5),
        (-4.0, 0.5),
        (-2.5, 3.5),
        (0.0, 1.0),
        (0.5, -2.0),
        (3.0, -0.5),
    ];
    let points: Vec<(f64, f64)> = points.iter().map(place).collect();
    path(&points, 0.6).unwrap()
}

/// A circle, or waypoints that turn by no more than a right angle.
fn trajectory(random: &mut Random, middle_x_m: f64) -> Trajectory {
    let speed_m_s = random.between(0.3..0.9);
    if random.chance(0.35) {
        let radius_m = random.between(1.0..3.0);
        let room_m = REGION_M - radius_m;
        let circle = json!({"circle": {
            "center": {
                "x_m": middle_x_m + random.between(-room_m..room_m),
                "y_m": random.between(-room_m..room_m),
            },
            "radius_m": radius_m,
            "speed_m_s": speed_m_s,
            "turns": random.between(0.6..1.8),
            "direction": if random.chance(0.5) { "clockwise" } else { "counter_clockwise" },
        }});
        return serde_json::from_value(circle).unwrap();
    }
    let mut points = vec![(
        random.between(-REGION_M..REGION_M),
        random.between(-REGION_M..REGION_M),
    )];
    let mut heading_rad = random.between(-3.0..3.0);
    for _ in 0..2 + random.index(4) {
        heading_rad += random.between(-1.4..1.4);
        let step_m = random.between(1.5..3.0);
        let (x_m, y_m) = points.last().copied().unwrap();
        points.push((
            x_m + step_m * heading_rad.cos(),
            y_m + step_m * heading_rad.sin(),
        ));
    }
    let points: Vec<(f64, f64)> = points
        .iter()
        .map(|(x_m, y_m)| (middle_x_m + x_m, *y_m))
        .collect();
    path(&points, speed_m_s).unwrap()
}

fn is_of_ground(binding: &Binding) -> bool {
    binding.limit == BindingLimit::Traction
}

/// The trajectory as a client sends it after its dry run: with the start of that.
fn expecting(mut trajectory: Trajectory, start: Pose) -> Trajectory {
    let options = match &mut trajectory {
        Trajectory::Circle(circle) => &mut circle.options,
        Trajectory::Waypoints(waypoints) => &mut waypoints.options,
    };
    options.expected_start = Some(start);
    trajectory
}

async fn dry_run(world: &World, robot: &RobotId, asked: &Trajectory) -> TrajectoryCheck {
    let body = json!({"site": SITE, "robot": robot, "trajectory": asked});
    let said: Value = world.rest.post("/v1/trajectories/check", &body).await;
    serde_json::from_value(said).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dry_runs_of_random_queues_agree_with_what_the_robots_plan() {
    let scenario = field();
    let mut world = World::start(&scenario.site).await.unwrap();
    world.draw(&scenario).await.unwrap();
    let mut surveys = Vec::new();
    for kind in [SCOUT, ROVER] {
        let entries: Vec<Entry> = (0..ROBOTS)
            .map(|number| Entry {
                robot: name(kind, number),
                model: Kind::Small.model(),
            })
            .collect();
        world.start_robots(&scenario, &entries).await.unwrap();
    }
    for number in 0..ROBOTS {
        let asked = survey(center_x_m(number));
        let sent = world.send(&site(), &name(SCOUT, number), &asked).await;
        surveys.push(sent.unwrap());
    }
    world.succeeded(&surveys).await.unwrap();
    keep_map_as_it_is(&world).await;
    let mut random = Random::new(SEED);
    let mut expected: Vec<(MissionId, TrajectoryCheck)> = Vec::new();
    for number in 0..ROBOTS {
        let robot = name(ROVER, number);
        for _ in 0..QUEUE {
            let asked = trajectory(&mut random, center_x_m(number));
            let said = dry_run(&world, &robot, &asked).await;
            let asked = expecting(asked, said.start);
            let sent = world.send(&site(), &robot, &asked).await.unwrap();
            expected.push((sent, said));
        }
    }
    let ids: Vec<MissionId> = expected.iter().map(|(id, _)| *id).collect();
    let driven = world.succeeded(&ids).await.unwrap();
    let mut limited = 0;
    for (detail, (_, said)) in driven.iter().zip(&expected) {
        let plan = detail.mission.plan.unwrap();
        let length = (said.length_m / plan.length_m - 1.0).abs();
        let duration = (said.duration_s / plan.duration_s - 1.0).abs();
        limited += u32::from(said.bindings.iter().any(is_of_ground));
        let said = format!(
            "{}: {:.3} m and {:.2} s from {:?}, said {:.3} m and {:.2} s from {:?}",
            detail.mission.robot,
            plan.length_m,
            plan.duration_s,
            plan.begin,
            said.length_m,
            said.duration_s,
            said.start,
        );
        assert!(
            length <= DIFFERENCE_MAX && duration <= DIFFERENCE_MAX,
            "{said}"
        );
    }
    assert!(limited >= 5, "the ground limits only {limited} of them");
    world.stop().await.unwrap();
}
