use std::io::Cursor;

use super::choices::Defaults;
use super::*;
use crate::config::TlsSource;

fn defaults(folder: &Path) -> Defaults {
    Defaults {
        config: folder.join("tread.toml"),
        token_file: None,
        is_root: false,
        host_name: Some("yard-server".to_owned()),
    }
}

fn addresses(choices: &Choices) -> [String; 2] {
    [choices.http.to_string(), choices.zenoh.to_string()]
}

/// Writes the choices and reads them as the server does.
fn read(choices: Choices) -> Config {
    let prepared = write_beside(choices).unwrap();
    prepared.finish().unwrap();
    let config = Config::load(&ServerArgs {
        config: Some(prepared.choices.config.clone()),
        ..ServerArgs::default()
    });
    assert_eq!(config.as_ref().ok(), Some(&prepared.config));
    config.unwrap()
}

#[test]
fn without_any_choice_the_server_is_for_this_machine_alone() {
    let folder = tempfile::tempdir().unwrap();
    let choices = Choices::of(&SetupArgs::default(), &defaults(folder.path())).unwrap();
    assert_eq!(addresses(&choices), ["127.0.0.1:8420", "127.0.0.1:7447"]);
    let steps = next_steps(&choices, None, false);
    for part in [
        "site = \"yard\", robot = \"rover-1\" and server = \"tcp/127.0.0.1:7447\"",
        "`[robots]`",
    ] {
        assert!(steps.contains(part), "`{part}` in {steps}");
    }
    // Nothing can be enrolled at this server.
    for part in ["join-token", "enroll"] {
        assert!(!steps.contains(part), "`{part}` in {steps}");
    }
    let config = read(choices);
    assert!(config.tls.is_none() && config.robots.is_none());
    assert_eq!(
        config.database,
        folder.path().join("tread-data/tread.db").into()
    );
}

#[test]
fn with_a_name_others_reach_it_by_tls_of_its_own_authority() {
    let folder = tempfile::tempdir().unwrap();
    let args = SetupArgs {
        names: vec!["tread.example.org".to_owned(), "192.0.2.1".to_owned()],
        ..SetupArgs::default()
    };
    let choices = Choices::of(&args, &defaults(folder.path())).unwrap();
    assert_eq!(addresses(&choices), ["0.0.0.0:8420", "0.0.0.0:7447"]);
    let config = read(choices.clone());
    assert_eq!(config.tls, Some(TlsSource::Authority));
    assert_eq!(config.certificate_names(), args.names);
    let robots = config.robots.unwrap();
    assert_eq!(robots.authority, folder.path().join("tread-data/authority"));
    let steps = next_steps(&choices, Some("abcd"), false);
    for part in [
        "tread login --server https://tread.example.org:8420 --ca-fingerprint abcd --token-file",
        "tread-agent enroll --server https://tread.example.org:8420 --ca-fingerprint abcd",
        "tread-server doctor --config",
    ] {
        assert!(steps.contains(part), "`{part}` in {steps}");
    }
}

#[test]
fn behind_a_proxy_only_the_proxy_reaches_the_rest_api() {
    let folder = tempfile::tempdir().unwrap();
    let args = SetupArgs {
        names: vec!["tread.example.org".to_owned()],
        tls: Some(TlsChoice::Proxy),
        ..SetupArgs::default()
    };
    let choices = Choices::of(&args, &defaults(folder.path())).unwrap();
    assert_eq!(addresses(&choices), ["127.0.0.1:8420", "0.0.0.0:7447"]);
    assert!(
        next_steps(&choices, Some("abcd"), false)
            .contains("--server https://tread.example.org --token")
    );
    let config = read(choices);
    assert!(config.web.behind_https && config.tls.is_none() && config.robots.is_some());
}

#[test]
fn what_cannot_be_is_refused_and_the_message_names_the_flag() {
    let folder = tempfile::tempdir().unwrap();
    let named = || SetupArgs {
        names: vec!["tread.example.org".to_owned()],
        ..SetupArgs::default()
    };
    let file = || Some(folder.path().join("missing.pem"));
    for (args, said) in [
        (
            SetupArgs {
                tls: Some(TlsChoice::Authority),
                ..SetupArgs::default()
            },
            "--names",
        ),
        (
            SetupArgs {
                names: vec!["https://tread.example.org".to_owned()],
                ..SetupArgs::default()
            },
            "without scheme",
        ),
        (
            SetupArgs {
                http: Some("192.0.2.1:80".parse().unwrap()),
                ..SetupArgs::default()
            },
            "--http 192.0.2.1:80",
        ),
        (
            SetupArgs {
                zenoh: Some("127.0.0.1:8420".parse().unwrap()),
                ..SetupArgs::default()
            },
            "--zenoh",
        ),
        (
            SetupArgs {
                tls: Some(TlsChoice::Files),
                ..named()
            },
            "--tls-certificate",
        ),
        (
            SetupArgs {
                tls_certificate: file(),
                tls_key: file(),
                ..named()
            },
            "missing.pem",
        ),
        (
            SetupArgs {
                tls: Some(TlsChoice::Proxy),
                tls_certificate: file(),
                tls_key: file(),
                ..named()
            },
            "--tls files alone",
        ),
    ] {
        let refused = Choices::of(&args, &defaults(folder.path())).unwrap_err();
        let refused = format!("{refused:#}");
        assert!(refused.contains(said), "`{said}` in {refused}");
    }
}

#[test]
fn a_certificate_for_another_name_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let names = vec!["else.example.org".to_owned()];
    let made = rcgen::generate_simple_self_signed(names).unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("cert.pem"), made.cert.pem()).unwrap();
    fs::write(at("key.pem"), made.signing_key.serialize_pem()).unwrap();
    let args = |name: &str| SetupArgs {
        names: vec![name.to_owned()],
        tls_certificate: Some(at("cert.pem")),
        tls_key: Some(at("key.pem")),
        ..SetupArgs::default()
    };
    let refused = Choices::of(&args("tread.example.org"), &defaults(folder.path())).unwrap_err();
    let refused = refused.to_string();
    assert!(refused.contains("else.example.org"), "{refused}");
    Choices::of(&args("else.example.org"), &defaults(folder.path())).unwrap();
}

/// Answers the questions with these lines.
fn answered(folder: &Path, args: &SetupArgs, lines: &str) -> (anyhow::Result<Choices>, String) {
    let (mut input, mut output) = (Cursor::new(lines.to_owned()), Vec::new());
    let mut questions = Questions::new(&mut input, &mut output);
    let choices = questions::ask(args, &defaults(folder), &mut questions);
    (choices, String::from_utf8(output).unwrap())
}

#[test]
fn enter_takes_what_is_in_brackets() {
    let folder = tempfile::tempdir().unwrap();
    let (choices, said) = answered(folder.path(), &SetupArgs::default(), &"\n".repeat(9));
    let choices = choices.unwrap_or_else(|error| panic!("{error:#}: {said}"));
    assert_eq!(choices.names, ["yard-server"]);
    assert_eq!(read(choices).tls, Some(TlsSource::Authority));
}

#[test]
fn an_answer_that_cannot_be_taken_is_explained_and_asked_again() {
    let folder = tempfile::tempdir().unwrap();
    let lines = "\n\nNo Site\npark\n7\n3\nhttp://x\ntread.example.org, 192.0.2.1\n\n\n\nno\n";
    let (choices, said) = answered(folder.path(), &SetupArgs::default(), lines);
    let refused = choices.unwrap_err().to_string();
    assert_eq!(refused, "nothing was written");
    for part in [
        "`No Site` cannot be taken",
        "`7` is none of 1, 2, 3, 4",
        "`http://x` is neither",
        "hosts = [\"tread.example.org\", \"192.0.2.1\"]",
        "site = \"park\"",
    ] {
        assert!(said.contains(part), "`{part}` in {said}");
    }
}

#[test]
fn whoever_does_not_answer_is_referred_to_the_flags() {
    let folder = tempfile::tempdir().unwrap();
    let (choices, _) = answered(folder.path(), &SetupArgs::default(), "\n");
    assert!(choices.unwrap_err().to_string().contains("--yes"));
    // Every answer to the third question, the site, is refused.
    let answers = format!("\n\n{}", "A b\n".repeat(6));
    let (choices, _) = answered(folder.path(), &SetupArgs::default(), &answers);
    let refused = choices.unwrap_err().to_string();
    assert!(refused.contains("no answer to `Site`"), "{refused}");
}

#[test]
fn nothing_that_exists_is_replaced_without_force() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tread.toml");
    fs::write(&file, "site = \"yard\"\n").unwrap();
    let refused = refuse_to_replace("configuration file", &file, false).unwrap_err();
    assert!(refused.to_string().contains("--force"), "{refused}");
    refuse_to_replace("configuration file", &file, true).unwrap();
    let link = folder.path().join("link");
    std::os::unix::fs::symlink(folder.path().join("nowhere"), &link).unwrap();
    assert!(refuse_to_replace("token file", &link, false).is_err());
    // With force, `init` keeps the former file.
    let choices = Choices::of(&SetupArgs::default(), &defaults(folder.path())).unwrap();
    read(choices);
    let old = fs::read_to_string(folder.path().join("tread.toml.old")).unwrap();
    assert_eq!(old, "site = \"yard\"\n");
}
