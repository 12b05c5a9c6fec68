//! A proxy that the environment of the server names does not get what is sent to webhooks.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};

use serde_json::json;
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tread_tests::fleet::Fleet;
use tread_tests::wait::{SHORT, eventually};

/// Receivers on this machine may be called, also without TLS.
const CONFIG: &str = r#"
[webhooks]
allow_http = true
allowed_networks = ["127.0.0.0/8", "::1/128"]
"#;
/// First byte of a TLS handshake.
const TLS_HANDSHAKE: u8 = 22;

/// Accepts connections and keeps the first bytes of each, until it is dropped.
struct Ear {
    address: SocketAddr,
    heard: Arc<Mutex<Vec<Vec<u8>>>>,
    _listening: JoinSet<()>,
}

impl Ear {
    async fn listen() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let heard = Arc::<Mutex<Vec<Vec<u8>>>>::default();
        let to = Arc::clone(&heard);
        let mut listening = JoinSet::new();
        listening.spawn(async move {
            // A connection is closed without an answer as soon as something came.
            while let Ok((mut connection, _)) = listener.accept().await {
                let mut first = vec![0; 1_024];
                let count = connection.read(&mut first).await.unwrap_or(0);
                first.truncate(count);
                to.lock().unwrap().push(first);
            }
        });
        Self {
            address,
            heard,
            _listening: listening,
        }
    }

    fn heard(&self) -> Vec<Vec<u8>> {
        self.heard.lock().unwrap().clone()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn proxies_of_the_environment_do_not_divert_deliveries_to_webhooks() {
    let (proxy, receiver) = (Ear::listen().await, Ear::listen().await);
    let url = format!("http://{}", proxy.address);
    let names = ["HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"];
    let small = names.map(str::to_lowercase);
    let all = names
        .iter()
        .copied()
        .chain(small.iter().map(String::as_str));
    let environment: Vec<(&str, &str)> = all
        .map(|name| (name, url.as_str()))
        // What this machine excepts is not excepted for the server.
        .chain([("NO_PROXY", ""), ("no_proxy", "")])
        .collect();
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let fleet = Fleet::start_in_environment(node, CONFIG, &environment).await;
    let port = receiver.address.port();
    for (scheme, host) in [
        ("http", "127.0.0.1"),
        ("https", "127.0.0.1"),
        ("http", "localhost"),
        ("https", "localhost"),
    ] {
        let before = receiver.heard().len();
        let name = format!("{scheme}-{host}");
        let webhook = json!({"name": name, "url": format!("{scheme}://{host}:{port}/alerts")});
        let made = fleet.rest.post("/v1/webhooks", &webhook).await;
        let id = made["webhook"]["id"].as_str().unwrap();
        let test = format!("/v1/webhooks/{id}/test");
        fleet.rest.post(&test, &json!({})).await;
        let look = || async { receiver.heard() };
        let heard = eventually("a delivery arrives", SHORT, look, |heard| {
            heard.len() > before
        })
        .await;
        let first = heard.last().unwrap();
        if scheme == "http" {
            let line = String::from_utf8_lossy(first);
            assert!(line.starts_with("POST /alerts HTTP/1.1"), "{line}");
        } else {
            assert_eq!(first.first(), Some(&TLS_HANDSHAKE), "{first:?}");
        }
        // It is not tried again.
        let path = format!("/v1/webhooks/{id}");
        let removed = fleet.rest.call(reqwest::Method::DELETE, &path, None).await;
        assert!(removed.unwrap().0.is_success());
    }
    assert!(proxy.heard().is_empty(), "{:?}", proxy.heard());
}
