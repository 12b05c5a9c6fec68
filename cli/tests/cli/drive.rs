//! `tread drive` in a terminal, over TLS.

use std::time::Duration;

use rcgen::{CertifiedKey, generate_simple_self_signed};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tread_api::safety::StopLatch;

use crate::terminal::{Terminal, eventually};
use crate::yard::{ROBOT, Yard};

impl Yard {
    /// `tread drive` once it has the lease.
    async fn drive(&self, port: u16) -> Terminal {
        // The server may not have heard of the robot yet.
        for _ in 0..50 {
            let mut terminal = self.tread(port, &["drive", ROBOT, "--name", "Ann"]);
            if terminal.shows_or_ends("you hold lease").await {
                return terminal;
            }
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
        panic!("no lease");
    }

    fn speed_m_s(&self) -> f64 {
        let twist = self.agent.state().twist;
        twist.map_or(0.0, |twist| twist.value.linear_m_s)
    }

    /// Holds a key until the robot is as fast as that.
    async fn hold(&self, terminal: &mut Terminal, key: &str, is: impl Fn(f64) -> bool) {
        for _ in 0..200 {
            terminal.press(key);
            tokio::time::sleep(Duration::from_millis(50)).await;
            if is(self.speed_m_s()) {
                return;
            }
        }
        panic!("{} m/s; {}", self.speed_m_s(), terminal.screen());
    }

    async fn stands_free(&self) {
        eventually("it stands, and nobody drives", || {
            self.speed_m_s().abs() < 0.02 && self.agent.state().safety.lease.is_none()
        })
        .await;
    }

    fn stop(&self) -> Option<StopLatch> {
        self.agent.state().safety.stop
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keys_drive_the_robot_over_tls_stop_it_and_every_way_out_restores_the_terminal() {
    let yard = Yard::start().await;
    let mut terminal = yard.drive(yard.port()).await;
    assert!(terminal.is_raw(), "keys do not come singly");
    let lease = yard.agent.state().safety.lease.unwrap();
    assert_eq!(lease.driver.name, "tests: Ann");
    yard.hold(&mut terminal, "w", |speed_m_s| speed_m_s > 0.2)
        .await;
    // The key is let go.
    eventually("it stands", || yard.speed_m_s().abs() < 0.02).await;
    yard.hold(&mut terminal, "\x1b[B", |speed_m_s| speed_m_s < -0.2)
        .await;
    eventually("it stands", || yard.speed_m_s().abs() < 0.02).await;
    assert!(yard.stop().is_none(), "letting go latches nothing");
    terminal.press("q");
    assert_eq!(terminal.ended().await, Some(0), "{}", terminal.screen());
    assert!(!terminal.is_raw(), "q left the terminal raw");
    yard.stands_free().await;

    let mut terminal = yard.drive(yard.port()).await;
    yard.hold(&mut terminal, "w", |speed_m_s| speed_m_s > 0.2)
        .await;
    terminal.press("\x03");
    assert_eq!(terminal.ended().await, Some(0), "{}", terminal.screen());
    assert!(!terminal.is_raw(), "Ctrl-C left the terminal raw");
    yard.stands_free().await;

    // A stop latches, whoever drives, and says how to clear it. Space means the same as on the page.
    for key in [" ", "x"] {
        let mut terminal = yard.drive(yard.port()).await;
        terminal.shows("space or x stops and latches").await;
        terminal.press(key);
        terminal.shows("stopped, confirmed").await;
        let latch = yard.stop().expect("it is stopped");
        terminal
            .shows(&format!("tread clear {ROBOT} {}", latch.id))
            .await;
        terminal.press("q");
        terminal.ended().await;
        let id = latch.id.to_string();
        let mut clearing = yard.tread(yard.port(), &["clear", ROBOT, &id]);
        assert_eq!(clearing.ended().await, Some(0), "{}", clearing.screen());
        assert!(yard.stop().is_none());
    }
    yard.end().await;
}

/// Carries bytes to a port until it is dropped; then every connection breaks.
struct Way {
    port: u16,
    carrying: JoinSet<()>,
}

impl Way {
    async fn to(port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut way = Self {
            port: listener.local_addr().unwrap().port(),
            carrying: JoinSet::new(),
        };
        way.carrying.spawn(async move {
            let mut connections = JoinSet::new();
            while let Ok((mut near, _)) = listener.accept().await {
                connections.spawn(async move {
                    let mut far = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
                    let _ended = tokio::io::copy_bidirectional(&mut near, &mut far).await;
                });
            }
        });
        way
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_lost_ends_the_drive_lets_the_robot_stand_and_restores_the_terminal() {
    let yard = Yard::start().await;
    let mut way = Way::to(yard.port()).await;
    let mut terminal = yard.drive(way.port).await;
    yard.hold(&mut terminal, "w", |speed_m_s| speed_m_s > 0.2)
        .await;
    way.carrying.shutdown().await;
    assert_eq!(terminal.ended().await, Some(1), "{}", terminal.screen());
    assert!(!terminal.is_raw(), "the loss left the terminal raw");
    terminal.shows("lost").await;
    yard.stands_free().await;

    let mut terminal = yard.drive(yard.port()).await;
    yard.hold(&mut terminal, "w", |speed_m_s| speed_m_s > 0.2)
        .await;
    yard.server.stop().await.unwrap();
    assert_eq!(terminal.ended().await, Some(1), "{}", terminal.screen());
    assert!(
        !terminal.is_raw(),
        "the server's stop left the terminal raw"
    );
    terminal.shows("the server is shutting down").await;
    eventually("it stands", || {
        let twist = yard.agent.state().twist;
        twist.is_none_or(|twist| twist.value.linear_m_s.abs() < 0.02)
    })
    .await;
    yard.agent.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_whose_certificate_is_not_trusted_is_not_driven_through() {
    let yard = Yard::start().await;
    let CertifiedKey { cert, .. } =
        generate_simple_self_signed(vec!["localhost".to_owned()]).unwrap();
    std::fs::write(yard.folder.path().join("cert.pem"), cert.pem()).unwrap();
    let mut terminal = yard.tread(yard.port(), &["drive", ROBOT]);
    assert_eq!(terminal.ended().await, Some(3), "{}", terminal.screen());
    assert!(!terminal.is_raw());
    assert!(yard.agent.state().safety.lease.is_none());
    yard.end().await;
}
