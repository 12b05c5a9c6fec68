//! `tread watch`: a picture in a terminal, a line for each change elsewhere.

use std::process::{Child, Command, Stdio};

use crate::terminal::eventually;
use crate::yard::{ROBOT, Yard};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_picture_shows_the_robot_stops_it_by_a_key_and_leaves_the_terminal_as_it_was() {
    let yard = Yard::start().await;
    let mut watch = yard.tread(yard.port(), &["watch"]);
    watch.shows(ROBOT).await;
    watch.shows("live").await;
    watch.shows("online").await;
    assert!(watch.is_raw());
    // All of the robot, and back.
    watch.press("\r");
    watch.shows("ticks,").await;
    watch.press("\x1b");
    watch.press("X");
    eventually("the robot is stopped", || {
        yard.agent.state().safety.stop.is_some()
    })
    .await;
    watch.shows("stopped;").await;
    watch.press("q");
    assert_eq!(watch.ended().await, Some(0), "{}", watch.screen());
    assert!(!watch.is_raw(), "the terminal is left raw");
    yard.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_a_terminal_each_change_is_a_line_and_a_lost_server_is_said() {
    let yard = Yard::start().await;
    let at = |name: &str| yard.folder.path().join(name).display().to_string();
    let lines = at("lines");
    let (out, errors) = (
        std::fs::File::create(&lines).unwrap(),
        std::fs::File::create(at("errors")).unwrap(),
    );
    let watch = Command::new(env!("CARGO_BIN_EXE_tread"))
        .args(["watch", "--site", "yard", "--ca", &at("cert.pem")])
        .args(["--server", &format!("https://localhost:{}", yard.port())])
        .args(["--token-file", &at("token")])
        .stdin(Stdio::null())
        .stdout(out)
        .stderr(errors)
        .spawn()
        .unwrap();
    let _watch = Ended(watch);
    let said = |name: &str| std::fs::read_to_string(at(name)).unwrap();
    eventually("the robot is said", || {
        said("lines").contains(&format!("robot    {ROBOT}  online, idle"))
    })
    .await;
    yard.table(&["stop", ROBOT, "--by", "Ann"]).await;
    eventually("the stop is said", || {
        said("lines").contains("STOPPED by tests: Ann")
    })
    .await;
    let count = |text: &str| said("lines").matches(text).count();
    assert_eq!(count("online, idle\n"), 1, "{}", said("lines"));
    yard.server.stop().await.unwrap();
    eventually("the loss is said", || {
        said("errors").contains("trying again")
    })
    .await;
    yard.agent.stop().await;
}

/// A program that ends with its test, however that ends.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
