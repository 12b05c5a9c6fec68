use super::*;

fn load(text: &str, arguments: &[&str]) -> Result<AgentConfig, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.toml");
    std::fs::write(&path, text).unwrap();
    let mut words = vec!["tread-agent", "--config", path.to_str().unwrap()];
    words.extend_from_slice(arguments);
    let flags = Flags::try_parse_from(words).unwrap();
    AgentConfig::load(&flags).map_err(|refused| refused.to_string())
}

const GOOD: &str = "site = \"yard\"\nrobot = \"rover-1\"\ndata_dir = \"/tmp/rover\"\n";

#[test]
fn defaults_fill_what_a_short_file_leaves_open() {
    let config = load(GOOD, &[]).unwrap();
    assert_eq!(config.servers.endpoints(), [SERVER_DEFAULT]);
    assert_eq!(config.server_timeout, Duration::from_secs(1));
    assert_eq!(config.period(), Duration::from_millis(10));
    assert_eq!(config.model, paper_robot());
    let drive = config.drive.simulated().unwrap();
    let seed = drive.individual.seed;
    assert_eq!(seed, 11, "the scenario's robot of that name");
}

const EXAMPLE: &str = include_str!("../../robot.example.toml");

#[test]
fn the_example_says_what_the_defaults_are() {
    let example = load(EXAMPLE, &[]).unwrap();
    let short = GOOD.replace("/tmp/rover", "/var/lib/tread-agent");
    // Its base is simulated, and equals its model.
    assert_eq!(example.prior, EstimatorPrior::exact());
    assert_eq!(example, load(&short, &[]).unwrap());
}

#[test]
fn what_the_example_shows_of_the_prior_are_the_defaults_of_a_real_robot() {
    let begin = EXAMPLE.find("[estimation]").unwrap();
    let length = EXAMPLE[begin..].find("\n\n").unwrap();
    let shown = &EXAMPLE[begin..begin + length];
    let stated = EXAMPLE.replace(shown, &shown.replace("\n# ", "\n"));
    let prior = load(&stated, &[]).unwrap().prior;
    let mut real = EstimatorPrior::default();
    real.tyres.unexplained_ratio = prior.tyres.unexplained_ratio;
    assert_eq!(prior, real);
}

#[test]
fn flags_go_before_the_file() {
    let start = [
        "--robot",
        "other",
        "--rate-hz",
        "50",
        "--start",
        "-1,2.5,0.1",
    ];
    let config = load(GOOD, &start).unwrap();
    assert_eq!(config.robot.as_str(), "other");
    assert_eq!(config.period(), Duration::from_millis(20));
    assert_eq!(
        config.drive.simulated().unwrap().start,
        Pose {
            x_m: -1.0,
            y_m: 2.5,
            heading_rad: 0.1
        }
    );
}

#[test]
fn a_mistake_is_named_with_file_line_and_key() {
    let cases = [
        ("rate = 100", "line 4", "rate"),
        ("rate_hz = \"fast\"", "line 4", "rate_hz"),
        ("[drive]\nkind = \"simulated\"\nsede = 1", "line 6", "sede"),
        ("[drive]\nkind = \"horse\"", "line 5", "horse"),
        ("[model]\nname = \"m\"\nmass = 3", "line 6", "mass"),
    ];
    for (line, place, key) in cases {
        let refused = load(&format!("{GOOD}{line}\n"), &[]).unwrap_err();
        for part in ["robot.toml", place, key] {
            assert!(refused.contains(part), "`{part}` is missing in: {refused}");
        }
    }
    for (line, key) in [
        ("rate_hz = 10.0", "rate_hz"),
        ("rate_hz = nan", "rate_hz"),
        ("state_rate_hz = 0.0", "state_rate_hz"),
    ] {
        let refused = load(&format!("{GOOD}{line}\n"), &[]).unwrap_err();
        assert!(refused.contains(key), "{refused}");
    }
    let refused = load("site = \"yard\"\n", &[]).unwrap_err();
    assert!(refused.contains("--robot"), "{refused}");
}

#[test]
fn another_machine_is_spoken_to_by_tls_alone_and_that_only_after_joining() {
    for good in [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:1",
        "tcp/localhost:1#so_sndbuf=9000",
    ] {
        let config = load(GOOD, &["--server", good]).unwrap();
        assert_eq!(config.servers.endpoints(), [good]);
        assert_eq!(config.membership, None);
    }
    for (bad, cure) in [
        ("tcp/192.0.2.7:7447", "without TLS"),
        ("https://tread.example:8420", "tls/HOST:7447"),
        ("http://127.0.0.1:8420", "tcp/127.0.0.1:7447"),
        ("udp/tread.example:7447", "without TLS"),
        ("tcp/localhost.example:7447", "without TLS"),
        ("tls/tread.example:7447", "tread-agent enroll"),
    ] {
        let refused = load(GOOD, &["--server", bad]).unwrap_err();
        assert!(refused.contains(cure), "{refused}");
    }
}

#[test]
fn several_servers_of_one_fleet_are_named_in_the_order_of_preference() {
    let (one, two) = ("tcp/127.0.0.1:1", "tcp/127.0.0.1:2");
    let list = format!("{GOOD}server = [\"{one}\", \"{two}\"]\nserver_timeout_s = 2.5\n");
    let config = load(&list, &[]).unwrap();
    assert_eq!(config.servers.endpoints(), [one, two]);
    assert!(config.servers.are_several());
    assert_eq!(config.server_timeout, Duration::from_millis(2_500));
    let config = load(&list, &["--server", &format!("{two},{one}")]).unwrap();
    assert_eq!(config.servers.endpoints(), [two, one]);
    for (line, words) in [
        ("server = []", "0 servers"),
        ("server = [\"tcp/[::1]:1\", \"tcp/[::1]:1\"]", "named twice"),
        ("server = [\"tls/a:1\", \"tcp/[::1]:1\"]", "all by `tls/`"),
        (
            "server = [\"tcp/[::1]:1\", \"tcp/192.0.2.7:1\"]",
            "without TLS",
        ),
        ("server = 7447", "an endpoint such as"),
        ("server_timeout_s = 0.1", "server_timeout_s"),
    ] {
        let refused = load(&format!("{GOOD}{line}\n"), &[]).unwrap_err();
        assert!(refused.contains(words), "{refused}");
    }
    let many: Vec<_> = (0..=SERVERS_MAX)
        .map(|port| format!("tcp/[::1]:{port}"))
        .collect();
    let refused = load(GOOD, &["--server", &many.join(",")]).unwrap_err();
    assert!(refused.contains("9 servers"), "{refused}");
}

#[test]
fn a_robot_without_a_start_is_refused() {
    let refused = load(GOOD, &["--robot", "stranger"]).unwrap_err();
    assert!(refused.contains("--start"), "{refused}");
}
