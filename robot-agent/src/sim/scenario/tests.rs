use super::*;

const GOOD: &str = r#"
site = "yard"
cell_m = 1.0

[[terrains]]
id = "slab"
class = "concrete"
polygon = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]
stiffness = 8.0

[[robots]]
id = "rover-1"
x_m = 1.0
y_m = 0.5
heading_rad = 0.0
seed = 1

[[missions]]
robot = "rover-1"
[missions.trajectory.circle]
center = { x_m = 0.0, y_m = 0.0 }
radius_m = 2.0
speed_m_s = 0.5
"#;

fn refusal(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "{from}");
    Scenario::parse(ScenarioText {
        file: "test.toml",
        text: &GOOD.replace(from, to),
    })
    .unwrap_err()
    .to_string()
}

#[test]
fn the_built_in_scenario_is_whole() {
    let scenario = Scenario::built_in().unwrap();
    assert!(scenario.terrains.len() >= 3);
    assert!(scenario.robots.len() >= 3);
    for robot in &scenario.robots {
        let missions = scenario
            .missions
            .iter()
            .filter(|mission| mission.robot == robot.id);
        assert!(
            missions.count() >= 2,
            "{} has hardly anything to do",
            robot.id
        );
    }
}

#[test]
fn a_mistake_is_named_with_file_line_and_key() {
    let cases = [
        ("stiffness = 8.0", "stifness = 8.0", "line 9", "stifness"),
        ("stiffness = 8.0", "stiffness = -8.0", "line 5", "stiffness"),
        ("stiffness = 8.0", "stiffness = nan", "line 5", "stiffness"),
        ("[4.0, 0.0], [4.0, 4.0]", "[4.0, 0.0]", "line 5", "polygon"),
        (
            "heading_rad = 0.0",
            "heading_rad = inf",
            "line 11",
            "heading_rad",
        ),
        (
            "robot = \"rover-1\"",
            "robot = \"rover-9\"",
            "line 18",
            "rover-9",
        ),
        ("radius_m = 2.0", "radius_m = 0.0", "line 22", "radius_m"),
        ("site = \"yard\"", "site = \"Yard!\"", "line 2", "Yard!"),
        ("cell_m = 1.0", "cell_m = 0.0", "cell_m", "0"),
        (
            "seed = 1",
            "seed = 1\nstiffness_ratio = nan",
            "line 11",
            "stiffness_ratio",
        ),
        (
            "seed = 1",
            "seed = 1\nfaults = [{ after_s = 9.0, until_s = 3.0, kind = \"ignores_commands\" }]",
            "line 11",
            "until_s",
        ),
        (
            "seed = 1",
            "seed = 1\nfaults = [{ after_s = 9.0, kind = \"scaled\", channel = \"gyro\", factor = nan }]",
            "line 11",
            "factor",
        ),
        (
            "stiffness = 8.0",
            "stiffness = 8.0\nthen = [{ after_s = -1.0, stiffness = 1.0 }]",
            "line 5",
            "after_s",
        ),
    ];
    for (from, to, place, key) in cases {
        let refused = refusal(from, to);
        for part in ["test.toml", place, key] {
            assert!(refused.contains(part), "`{part}` is missing in: {refused}");
        }
    }
    assert!(
        Scenario::parse(ScenarioText {
            file: "test.toml",
            text: GOOD
        })
        .is_ok()
    );
}

#[test]
fn doubled_names_are_refused() {
    let second = "\n[[robots]]\nid = \"rover-1\"\nx_m = 0\ny_m = 0\nheading_rad = 0\nseed = 2\n";
    let refused = Scenario::parse(ScenarioText {
        file: "test.toml",
        text: &format!("{GOOD}{second}"),
    })
    .unwrap_err();
    assert!(refused.to_string().contains("twice"), "{refused}");
}
