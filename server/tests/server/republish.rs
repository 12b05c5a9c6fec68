//! States, friction and map changes at a zenoh router for subscribers.

use std::net::{SocketAddr, TcpListener};

use tokio::sync::mpsc;
use tread_api::friction::MapChange;
use tread_api::wire::state::RobotState;
use tread_api::{keys, wire};
use tread_server::config::RepublishConfig;
use zenoh::Wait as _;

use crate::harness::{PATIENCE, Yard, measured, segment, site};
use crate::robot::Robot;

/// Number of messages that wait to be read by the test.
const HEARD_MAX: usize = 1_000;

fn open(mode: &str, key: &str, address: SocketAddr) -> zenoh::Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("\"{mode}\"")),
        (key, format!("[\"tcp/{address}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// A router of a site's subscribers.
fn router(address: SocketAddr) -> zenoh::Session {
    open("router", "listen/endpoints", address)
}

/// Keys and payloads of what is published at a router.
fn subscriber(address: SocketAddr) -> (zenoh::Session, mpsc::Receiver<(String, Vec<u8>)>) {
    let session = open("client", "connect/endpoints", address);
    let (heard, hearing) = mpsc::channel(HEARD_MAX);
    session
        .declare_subscriber("tread/**")
        .callback(move |sample| {
            let payload = sample.payload().to_bytes().into_owned();
            let _full = heard.try_send((sample.key_expr().as_str().to_owned(), payload));
        })
        .background()
        .wait()
        .unwrap();
    (session, hearing)
}

/// Waits for a message with a key that the server republishes.
async fn next_of(hearing: &mut mpsc::Receiver<(String, Vec<u8>)>, key: &str) -> Vec<u8> {
    let hearing = async {
        loop {
            let (of, payload) = hearing.recv().await.unwrap();
            if of == key {
                return payload;
            }
        }
    };
    tokio::time::timeout(PATIENCE, hearing).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn subscribers_receive_what_robots_publish_also_after_their_router_was_away() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let at_router = RepublishConfig { router: address };
    // The server starts without the router, and robots are served.
    let yard = Yard::start_configured(|config, _| config.republish = Some(at_router)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let state_key = keys::state(&site(), &robot.id);
    let first = router(address);
    let (session, mut hearing) = subscriber(address);
    let state: RobotState = wire::decode(&next_of(&mut hearing, &state_key).await).unwrap();
    assert_eq!((state.robot, state.boot), (robot.id.clone(), robot.boot));
    let uploaded = robot.upload(vec![measured(1, segment((2, 2), 0.2, 10))]);
    uploaded.await.unwrap();
    let change = next_of(&mut hearing, &keys::map(&site())).await;
    let change: MapChange = wire::decode(&change).unwrap();
    assert_eq!(change.site, site());

    session.close().wait().unwrap();
    first.close().wait().unwrap();
    let second = router(address);
    let (session, mut hearing) = subscriber(address);
    next_of(&mut hearing, &state_key).await;
    session.close().wait().unwrap();
    drop(robot);
    yard.server.stop().await.unwrap();
    second.close().wait().unwrap();
}
