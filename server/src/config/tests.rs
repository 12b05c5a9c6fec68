use super::*;

pub(super) fn load(text: &str) -> Result<Config, ConfigError> {
    load_bytes(text.as_bytes())
}

fn load_bytes(text: &[u8]) -> Result<Config, ConfigError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tread.toml");
    std::fs::write(&path, text).unwrap();
    Config::load(&ServerArgs {
        config: Some(path),
        ..ServerArgs::default()
    })
}

#[test]
fn an_unknown_key_is_named_with_its_file_and_line() {
    let error = load("site = \"yard\"\nhtpp = \"127.0.0.1:1\"\n")
        .unwrap_err()
        .to_string();
    assert!(error.contains("tread.toml"), "{error}");
    assert!(error.contains("line 2"), "{error}");
    assert!(error.contains("htpp"), "{error}");
    let nested = load("[friction]\nbias = 1.0\n").unwrap_err().to_string();
    assert!(
        nested.contains("line 2") && nested.contains("bias"),
        "{nested}"
    );
}

#[test]
fn a_file_that_is_no_text_is_called_that() {
    let error = load_bytes(b"site = \"yard\" # \xff\n")
        .unwrap_err()
        .to_string();
    assert!(error.contains("UTF-8"), "{error}");
}

#[test]
fn the_memory_for_the_map_is_bounded() {
    let default = load("").unwrap().map;
    assert_eq!(default.memory_max_mib, 4_096);
    let small = load("[map]\nmemory_max_mib = 64").unwrap().map;
    assert_eq!(small.memory_max_mib, 64);
    let error = load("[map]\nmemory_max_mib = 63").unwrap_err().to_string();
    assert!(
        error.contains("map.memory_max_mib") && error.contains("64 to 1e9"),
        "{error}"
    );
}

#[test]
fn a_value_that_is_not_possible_is_named() {
    let error = load("site = \"A B\"\n").unwrap_err().to_string();
    assert!(error.contains("line 1") && error.contains("A B"), "{error}");
    let nan = load("[friction]\nrobot_bias_ratio = nan\n")
        .unwrap_err()
        .to_string();
    assert!(nan.contains("friction.robot_bias_ratio"), "{nan}");
}

#[test]
fn how_long_measurements_are_kept_is_bounded() {
    let kept = load("[retention]\nsegments_days = 7").unwrap().retention;
    assert_eq!(kept.segments_days, 7);
    assert_eq!(kept.segments_max, RetentionConfig::default().segments_max);
    assert_eq!(kept.archive, None);
    let kept = load("[retention]\narchive = \"/srv/measurements\"")
        .unwrap()
        .retention;
    assert_eq!(
        kept.archive,
        Some(std::path::PathBuf::from("/srv/measurements").into())
    );
    for wrong in [
        "segments_days = 0",
        "segments_max = 10",
        "segments_hours = 1",
    ] {
        let error = load(&format!("[retention]\n{wrong}")).unwrap_err();
        assert!(error.to_string().contains("segments_"), "{error}");
    }
}

#[test]
fn a_normalisation_names_its_reference_and_its_ratios() {
    let id = "11111111-1111-4111-8111-111111111111";
    let text = |ratio: &str| {
        format!("[normalisations.all]\nreference = \"{id}\"\nratios = {{ \"{id}\" = {ratio} }}\n")
    };
    let declared = load(&text("1.3")).unwrap().normalisations;
    assert_eq!(declared[0].name, "all");
    for bad in ["0.0", "-1.0", "nan"] {
        let error = load(&text(bad)).unwrap_err().to_string();
        assert!(error.contains("ratios"), "{error}");
    }
}

#[test]
fn an_address_beyond_this_machine_is_refused_with_a_sentence() {
    for text in [
        "http = \"0.0.0.0:8080\"",
        "zenoh = \"192.0.2.7:7447\"",
        "http = \"[::]:1\"",
    ] {
        let error = load(text).unwrap_err().to_string();
        assert!(error.contains("other machines can reach"), "{error}");
    }
    assert!(load("http = \"[::1]:8080\"").is_ok());
}

#[test]
fn with_a_certificate_the_rest_api_may_be_reached_and_the_rest_may_not() {
    let tls = "[tls]\ncertificate = \"c.pem\"\nkey = \"k.pem\"";
    let config = load(&format!("http = \"0.0.0.0:443\"\n{tls}")).unwrap();
    assert!(config.names().is_tls);
    let robots = "[robots]\nauthority = \"ca\"\n";
    assert!(load(&format!("zenoh = \"0.0.0.0:1\"\n{robots}")).is_ok());
    for wrong in [
        "names = [\"a b\"]",
        "certificate_s = 4",
        "robots_per_router = 0",
    ] {
        let error = load(&format!("{robots}{wrong}")).unwrap_err();
        assert!(error.to_string().contains("robots."), "{error}");
    }
    for key in ["zenoh", "metrics"] {
        let error = load(&format!("{key} = \"0.0.0.0:1\"\n{tls}")).unwrap_err();
        assert!(
            error.to_string().contains("other machines can reach"),
            "{error}"
        );
    }
    let half = load("[tls]\ncertificate = \"c.pem\"").unwrap_err();
    assert!(half.to_string().contains("key"), "{half}");
}

#[test]
fn a_trusted_proxy_is_an_address_or_a_network() {
    let config = load("[web]\ntrusted_proxies = [\"127.0.0.1\", \"fd00::/8\"]").unwrap();
    assert_eq!(config.web.trusted_proxies.len(), 2);
    let said = load("[web]\ntrusted_proxies = [\"proxy\"]")
        .unwrap_err()
        .to_string();
    assert!(
        said.contains("line 2") && said.contains("`proxy` is no address"),
        "{said}"
    );
}

#[test]
fn an_origin_that_is_none_is_named() {
    let error = load("[web]\nallowed_origins = [\"*\"]").unwrap_err();
    let said = error.to_string();
    assert!(
        said.contains("line 2") && said.contains("`*` is no origin"),
        "{said}"
    );
}

#[test]
fn a_flag_wins_over_the_file_and_the_file_over_the_built_in_value() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tread.toml");
    std::fs::write(&path, "http = \"127.0.0.1:1\"\nzenoh = \"127.0.0.1:2\"").unwrap();
    let args = ServerArgs {
        config: Some(path),
        http: Some("127.0.0.1:3".parse().unwrap()),
        ..ServerArgs::default()
    };
    let config = Config::load(&args).unwrap();
    assert_eq!((config.http.port(), config.zenoh.port()), (3, 2));
    assert_eq!(config.site.as_str(), SITE_DEFAULT);
}

#[test]
fn a_router_for_subscribers_is_on_this_machine() {
    let at = |address: &str| load(&format!("[republish]\nrouter = \"{address}\"\n"));
    let config = at("127.0.0.1:7448").unwrap();
    let router = "127.0.0.1:7448".parse().unwrap();
    assert_eq!(config.republish, Some(RepublishConfig { router }));
    assert_eq!(load("").unwrap().republish, None);
    let error = at("192.168.1.2:7448").unwrap_err().to_string();
    assert!(
        error.contains("`republish.router` is 192.168.1.2:7448, which other machines can reach"),
        "{error}"
    );
}

#[test]
fn listeners_with_the_same_address_are_named() {
    let both = load("http = \"127.0.0.1:8420\"\nmetrics = \"127.0.0.1:8420\"\n");
    let error = both.unwrap_err().to_string();
    assert!(
        error.contains("`http` and `metrics` are both 127.0.0.1:8420"),
        "{error}"
    );
    load("http = \"127.0.0.1:0\"\nzenoh = \"127.0.0.1:0\"\n").unwrap();
    let own = load("zenoh = \"127.0.0.1:7447\"\n[republish]\nrouter = \"127.0.0.1:7447\"\n");
    let error = own.unwrap_err().to_string();
    assert!(error.contains("`zenoh` and `republish.router`"), "{error}");
    load("http = \"127.0.0.1:8420\"\nzenoh = \"127.0.0.2:8420\"\n").unwrap();
}

#[test]
fn a_database_is_a_file_or_an_address_of_postgresql_that_the_server_does_not_back_up() {
    let config = load("database = \"postgres://tread@127.0.0.1/fleet\"\n").unwrap();
    assert!(config.database.is_postgres());
    let text = "database = \"postgres://u:hunter2@h/d\"\n[backup]\nfolder = \"/tmp\"\n";
    let error = load(text).unwrap_err().to_string();
    assert!(error.contains("pg_dump"), "{error}");
    assert!(!error.contains("hunter2"), "{error}");
}

#[test]
fn an_advertised_url_is_a_name_of_the_server_and_is_reached_by_tls() {
    let tls = "[tls]\ncertificate = \"c.pem\"\nkey = \"k.pem\"\n";
    let advertised = |url: &str| load(&format!("{tls}[web]\nadvertise_url = \"{url}\"\n"));
    let config = advertised("https://server-a.example.org:8420").unwrap();
    assert_eq!(config.names().hosts, ["server-a.example.org"]);
    assert_eq!(config.certificate_names(), ["server-a.example.org"]);
    let config = advertised("https://[2001:db8::1]:8420").unwrap();
    assert_eq!(config.certificate_names(), ["2001:db8::1"]);
    for here in [
        "http://127.0.0.1:8420",
        "http://[::1]:8420",
        "http://localhost",
    ] {
        advertised(here).unwrap();
    }
    for wrong in ["http://server-a.example.org", "http://10.0.0.1:8420"] {
        let error = advertised(wrong).unwrap_err().to_string();
        assert!(error.contains("https://"), "{wrong}: {error}");
    }
    let error = advertised("server-a").unwrap_err().to_string();
    assert!(error.contains("is no origin"), "{error}");
}
