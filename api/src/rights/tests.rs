use super::*;

fn scope(names: &[&str]) -> Scope {
    Scope::from_names(names.iter().copied()).unwrap()
}

#[test]
fn each_role_is_the_rights_of_the_weaker_ones_and_more() {
    let of = |role: Role| Rights::from(role);
    assert_eq!(of(Role::Viewer).to_string(), "stop, read");
    assert!(of(Role::Viewer).only_watches() && !of(Role::Operator).only_watches());
    assert!(!of(Role::Operator).includes(Right::Administer));
    assert!(
        Right::ALL
            .iter()
            .all(|&right| of(Role::Admin).includes(right))
    );
    for (weaker, stronger) in [
        (Role::Viewer, Role::Operator),
        (Role::Operator, Role::Admin),
    ] {
        assert!(of(stronger).includes_all(of(weaker)));
        assert!(!of(weaker).includes_all(of(stronger)));
    }
}

#[test]
fn stop_comes_with_every_right_and_read_with_every_other() {
    for right in Right::ALL {
        let rights: Rights = [right].into_iter().collect();
        assert!(rights.includes(Right::Stop), "{right}");
        assert_eq!(
            rights.includes(Right::Read),
            right != Right::Stop,
            "{right}"
        );
        assert_eq!(right.as_str().parse(), Ok(right));
        assert_eq!(
            InvalidRight
                .to_string()
                .matches(&format!("`{right}`"))
                .count(),
            1
        );
    }
    assert_eq!(Rights::default().iter().count(), 0);
}

#[test]
fn a_scope_includes_its_sites_and_robots_and_nothing_else() {
    let (yard, field): (SiteId, SiteId) = ("yard".parse().unwrap(), "field".parse().unwrap());
    let (first, second): (RobotId, RobotId) =
        ("rover-1".parse().unwrap(), "rover-2".parse().unwrap());
    let limited = scope(&["yard/rover-1", "park"]);
    assert!(limited.includes_site(&yard) && !limited.includes_whole_site(&yard));
    assert!(limited.includes_robot(&yard, &first) && !limited.includes_robot(&yard, &second));
    assert!(!limited.includes_site(&field) && !limited.includes_robot(&field, &first));
    assert!(Scope::EVERYWHERE.includes_whole_site(&field));
    assert!(Scope::EVERYWHERE.includes(&limited) && !limited.includes(&Scope::EVERYWHERE));
    assert!(scope(&["yard", "park"]).includes(&limited));
    assert!(limited.includes(&scope(&["park/rover-9"])));
    assert!(!limited.includes(&scope(&["yard"])));
    assert_eq!(scope(&["yard/rover-1"]).only_site(), Some(&yard));
    assert_eq!(limited.only_site(), None);
}

#[test]
fn a_union_of_scopes_has_what_is_in_either_and_nothing_else() {
    let union = |one: &[&str], other: &[&str]| scope(one).union(&scope(other));
    assert_eq!(
        union(&["yard/rover-1", "park"], &["yard/rover-2", "field"]),
        scope(&["yard/rover-1", "yard/rover-2", "park", "field"])
    );
    assert_eq!(union(&["yard/rover-1"], &["yard"]), scope(&["yard"]));
    assert_eq!(union(&["yard"], &["yard/rover-1"]), scope(&["yard"]));
    let all = scope(&["yard"]).union(&Scope::EVERYWHERE);
    assert!(all.is_everywhere() && Scope::EVERYWHERE.union(&scope(&["yard"])) == all);
}

#[test]
fn a_scope_reads_back_as_it_was_written_and_is_never_empty() {
    let limited = scope(&["yard/rover-1", "yard/rover-2", "park"]);
    let text = serde_json::to_string(&limited).unwrap();
    assert_eq!(
        text,
        r#"[{"site":"park"},{"site":"yard","robots":["rover-1","rover-2"]}]"#
    );
    assert_eq!(serde_json::from_str::<Scope>(&text).unwrap(), limited);
    let names = limited.names().unwrap();
    assert_eq!(
        Scope::from_names(names.iter().map(String::as_str)),
        Ok(limited)
    );
    assert_eq!(serde_json::to_string(&Scope::EVERYWHERE).unwrap(), "null");
    for wrong in [
        "[]",
        r#"[{"site":"yard","robots":[]}]"#,
        r#"[{"site":"yard"},{"site":"yard"}]"#,
    ] {
        assert!(serde_json::from_str::<Scope>(wrong).is_err(), "{wrong}");
    }
    let many = (0..=SCOPE_SITES_MAX).map(|number| format!("site-{number}"));
    let many: Vec<String> = many.collect();
    let many = Scope::from_names(many.iter().map(String::as_str));
    assert_eq!(many, Err(InvalidScope::TooMany));
}
