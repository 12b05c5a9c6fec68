//! Completions and man pages.

use std::io::Write as _;
use std::process::{Command, Stdio};

use crate::yard::Ran;

async fn tread(words: &[&str]) -> Ran {
    Ran::of(words.iter().map(|word| (*word).to_owned()).collect()).await
}

#[tokio::test]
async fn each_shell_gets_completions_and_bash_can_read_its_own() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let ran = tread(&["completions", shell]).await;
        assert_eq!(ran.code, Some(0), "{shell}: {}", ran.errors);
        for word in ["friction", "missions", "acknowledge"] {
            assert!(ran.text.contains(word), "{shell} does not know {word}");
        }
        if shell == "bash" {
            let reading = Command::new("bash").arg("-n").stdin(Stdio::piped()).spawn();
            let mut reading = reading.unwrap();
            let mut input = reading.stdin.take().unwrap();
            input.write_all(ran.text.as_bytes()).unwrap();
            drop(input);
            assert!(reading.wait().unwrap().success());
        }
    }
    assert_eq!(tread(&["completions", "dos"]).await.code, Some(2));
}

#[tokio::test]
async fn every_command_has_a_man_page_with_its_example() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path().join("man1");
    let ran = tread(&["man", "--dir", at.to_str().unwrap()]).await;
    assert_eq!(ran.code, Some(0), "{}", ran.errors);
    let page = |name: &str| std::fs::read_to_string(at.join(name)).unwrap();
    for name in [
        "tread.1",
        "tread-missions-wait.1",
        "tread-friction-point.1",
        "tread-robots-join-token-list.1",
    ] {
        assert!(page(name).contains("Examples:"), "{name}");
    }
    assert!(page("tread.1").contains("Exit codes"));
    assert!(
        !at.join("tread-agent.1").exists(),
        "it is no command for people"
    );
}

#[tokio::test]
async fn server_and_agent_have_man_pages_and_completions_too() {
    let folder = tempfile::tempdir().unwrap();
    for (program, page, word) in [
        ("tread-server", "tread-server-health.1", "--ready"),
        ("tread-agent", "tread-agent-enroll.1", "--token-file"),
    ] {
        let at = folder.path().join(program);
        let of_program = ["--program", program];
        let ran = tread(&[&["man", "--dir", at.to_str().unwrap()][..], &of_program].concat()).await;
        assert_eq!(ran.code, Some(0), "{}", ran.errors);
        let read = |name: &str| std::fs::read_to_string(at.join(name)).unwrap();
        assert!(read(page).replace('\\', "").contains(word), "{page}");
        let main = read(&format!("{program}.1"));
        assert!(main.contains(".SH SYNOPSIS"), "{main}");
        for shell in ["bash", "zsh", "fish"] {
            let ran = tread(&[&["completions", shell][..], &of_program].concat()).await;
            assert_eq!(ran.code, Some(0), "{shell}: {}", ran.errors);
            let word = word.trim_start_matches('-');
            assert!(ran.text.contains(word), "{program} in {shell}");
        }
    }
}
