//! What `deploy/` ships besides packages: the compose file, and the router for programs that listen.

#![expect(
    clippy::unwrap_used,
    reason = "what the helpers of a test cannot do fails the test"
)]

use std::time::Duration;

use tread_tests::ports::free_address;
use tread_tests::repository::root;
use zenoh::Wait as _;

/// Longest wait for a sample.
const PATIENCE: Duration = Duration::from_secs(15);
const STATE: &str = "tread/yard/robots/rover-1/state";

fn compose() -> String {
    std::fs::read_to_string(root().join("deploy/compose.yaml")).unwrap()
}

#[test]
fn what_the_compose_file_mounts_is_there() {
    let text = compose();
    let mounts = text.lines().filter_map(|line| {
        let mount = line.trim().strip_prefix("- ./")?;
        mount.strip_suffix(":ro")?.split(':').next()
    });
    let mut count = 0;
    for mount in mounts {
        assert!(root().join("deploy").join(mount).exists(), "{mount}");
        count += 1;
    }
    assert!(count >= 6, "{count} were found");
}

#[test]
fn the_health_check_of_the_compose_file_is_a_command_of_the_server() {
    let text = compose();
    let line = text.lines().find(|line| line.trim().starts_with("test:"));
    let list = line.unwrap().split_once(": ").unwrap().1;
    let words: Vec<String> = serde_json::from_str(list).unwrap();
    assert_eq!(words[0], "CMD");
    assert_eq!(words[1], "/usr/bin/tread-server");
    let read = tread_server::command_line().try_get_matches_from(&words[1..]);
    assert_eq!(read.unwrap().subcommand_name(), Some("health"));
}

#[test]
fn the_example_of_the_packages_is_a_configuration() {
    let args = tread_server::ServerArgs {
        config: Some(root().join("deploy/tread.example.toml")),
        ..tread_server::ServerArgs::default()
    };
    let config = tread_server::Config::load(&args).unwrap();
    assert_eq!(
        config.database,
        std::path::Path::new("/var/lib/tread/tread.db").into()
    );
    assert!(config.metrics.is_some(), "the compose file scrapes it");
}

/// A session of another program at a router.
fn client(router: &str) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    let endpoints = format!("[\"{router}\"]");
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", &endpoints),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// The router of a site's subscribers, for clients that come from another machine. zenoh is compiled without
/// TLS here.
fn router(address: &str) -> zenoh::Session {
    let file = root().join("deploy/zenoh/zenohd.json5");
    let text = std::fs::read_to_string(file).unwrap();
    let text = text
        .replace(", \"tls/[::]:7449\"", "")
        .replace("tcp/127.0.0.1:7448", address)
        .replace("\"lo\"", "\"no-such-interface\"");
    let config = zenoh::Config::from_json5(&text).unwrap();
    zenoh::open(config).wait().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn subscribers_at_the_router_for_them_receive_states_and_publish_none() {
    let address = format!("tcp/{}", free_address());
    let router = router(&address);
    let listener = client(&address);
    let (heard, mut hearing) = tokio::sync::mpsc::channel(16);
    let subscriber = listener
        .declare_subscriber("tread/**")
        .callback(move |sample| {
            let text = sample.payload().try_to_string().unwrap_or_default();
            _ = heard.try_send(text.into_owned());
        })
        .wait()
        .unwrap();
    let mut next = async || {
        let next = tokio::time::timeout(PATIENCE, hearing.recv()).await;
        next.unwrap().unwrap()
    };
    // Until the subscription has arrived, nothing is sent.
    let publisher = router.declare_publisher(STATE).wait().unwrap();
    tokio::time::timeout(PATIENCE, async {
        while !publisher.matching_status().wait().unwrap().matching() {
            tokio::task::yield_now().await;
        }
    })
    .await
    .unwrap();
    publisher.put("first").wait().unwrap();
    assert_eq!(next().await, "first");
    let stranger = client(&address);
    stranger.put(STATE, "forged").wait().unwrap();
    // What was sent before the end of the session has arrived with it.
    stranger.close().wait().unwrap();
    publisher.put("second").wait().unwrap();
    assert_eq!(next().await, "second");
    drop(subscriber);
    listener.close().wait().unwrap();
    router.close().wait().unwrap();
}
