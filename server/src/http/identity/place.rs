//! Compares the site and robot of a request with the scope of its token.
//!
//! | the route names | a token that is limited to sites or robots needs |
//! |---|---|
//! | a robot | this robot |
//! | a site, to read it | the site or some of its robots: lists show these alone |
//! | a site, to change it | the whole site |
//! | a mission, an alert, a token, a session | the robot that it is of, or all that the token holds for |
//! | none of these | to be on [`CHECKED_BY_HANDLERS`]; else a token for everything |
//!
//! Sites and robots in the query are held against it here, those in bodies by the handlers.

use axum::RequestExt as _;
use axum::extract::{RawPathParams, Request};
use axum::http::Method;
use tread_api::ids::{
    AlertId, JoinTokenId, MissionId, OwnerId, RobotId, SessionId, SiteId, TokenId,
};
use tread_api::rights::Right;

use crate::app::identity::Credential;
use crate::app::{App, AppError};
use crate::http::extract::Query;

/// Routes without a site that show or do only what is in the caller's scope, which their handlers
/// ensure.
pub(super) const CHECKED_BY_HANDLERS: [(&str, &str); 16] = [
    ("GET", "/v1/alerts"),
    ("GET", "/v1/events"),
    ("GET", "/v1/join-tokens"),
    ("POST", "/v1/join-tokens"),
    ("GET", "/v1/missions"),
    ("POST", "/v1/missions"),
    ("GET", "/v1/server"),
    ("GET", "/v1/session"),
    ("DELETE", "/v1/session"),
    ("GET", "/v1/sessions"),
    ("GET", "/v1/sites"),
    ("POST", "/v1/stop"),
    ("GET", "/v1/stops"),
    ("GET", "/v1/tokens"),
    ("POST", "/v1/tokens"),
    ("POST", "/v1/trajectories/check"),
];

/// Path parameters that name the object of a request.
#[derive(Debug, Default)]
struct Named {
    site: Option<SiteId>,
    robot: Option<RobotId>,
    mission: Option<MissionId>,
    alert: Option<AlertId>,
    token: Option<String>,
    session: Option<SessionId>,
}

/// Refuses a request outside the token's scope.
///
/// # Errors
/// [`AppError::OutsideScope`], or the database failed.
pub(super) async fn check(
    app: &App,
    request: &mut Request,
    (route, right): (&str, Right),
    who: &Credential,
) -> Result<(), AppError> {
    if who.scope.is_everywhere() {
        return Ok(());
    }
    let named = named(request).await;
    check_query(request, &named, who).await?;
    match named {
        Named {
            site: Some(site),
            robot: Some(robot),
            ..
        } => who.check_robot(&site, &robot),
        Named {
            site: Some(site), ..
        } if matches!(right, Right::Read | Right::Stop) => who.check_site(&site),
        Named {
            site: Some(site), ..
        } => who.check_whole_site(&site),
        Named {
            mission: Some(mission),
            ..
        } => match app.mission_place(mission).await? {
            Some((site, robot)) => who.check_robot(&site, &robot),
            // An unknown object is refused by the handler.
            None => Ok(()),
        },
        Named {
            alert: Some(alert), ..
        } => match app.alert_place(alert).await? {
            Some((site, robot)) => who.check_robot(&site, &robot),
            None => who.check_everywhere(),
        },
        Named {
            token: Some(token), ..
        } if route.starts_with("/v1/join-tokens") => check_join_token(app, &token, who).await,
        Named {
            token: Some(token), ..
        } => check_token(app, &token, who).await,
        Named {
            session: Some(session),
            ..
        } => match app.session_scope(session).await? {
            Some(scope) => who.check_scope(&scope),
            None => Ok(()),
        },
        _ if is_held_by_handler(request.method(), route) => Ok(()),
        _ => who.check_everywhere(),
    }
}

fn is_held_by_handler(method: &Method, route: &str) -> bool {
    // HEAD needs the same scope as GET.
    let method = if method == Method::HEAD {
        Method::GET.as_str()
    } else {
        method.as_str()
    };
    CHECKED_BY_HANDLERS.contains(&(method, route))
}

async fn named(request: &mut Request) -> Named {
    let mut named = Named::default();
    // An invalid path names nothing, and its handler refuses it.
    let Ok(params) = request.extract_parts::<RawPathParams>().await else {
        return named;
    };
    for (name, value) in &params {
        match name {
            "site" => named.site = value.parse().ok(),
            "robot" => named.robot = value.parse().ok(),
            "mission" => named.mission = value.parse().ok(),
            "alert" => named.alert = value.parse().ok(),
            "token" => named.token = Some(value.to_owned()),
            "session" => named.session = value.parse().ok(),
            _ => {}
        }
    }
    named
}

/// Returns the owner whose limit a request sets or ends, if the caller may not do that.
pub(super) async fn foreign_owner(
    request: &mut Request,
    right: Right,
    who: &Credential,
) -> Option<OwnerId> {
    if right != Right::Hold {
        return None;
    }
    let Named { site, robot, .. } = named(request).await;
    let params = request.extract_parts::<RawPathParams>().await.ok()?;
    let mut owners = params.iter().filter(|(name, _)| *name == "owner");
    let owner: OwnerId = owners.next()?.1.parse().ok()?;
    let may_release = |(site, robot)| who.may_at(Right::ReleaseHold, &site, &robot);
    let is_own = who.may_hold_as(&owner) || site.zip(robot).is_some_and(may_release);
    (!is_own).then_some(owner)
}

async fn check_query(
    request: &mut Request,
    named: &Named,
    who: &Credential,
) -> Result<(), AppError> {
    let pairs = request
        .extract_parts::<Query<Vec<(String, String)>>>()
        .await;
    // An invalid query is refused by its handler.
    let Ok(Query(pairs)) = pairs else {
        return Ok(());
    };
    let mut sites: Vec<SiteId> = named.site.iter().cloned().collect();
    for (_, value) in pairs.iter().filter(|(name, _)| name == "site") {
        if let Ok(site) = value.parse() {
            who.check_site(&site)?;
            sites.push(site);
        }
    }
    let robots = pairs
        .iter()
        .filter(|(name, _)| name == "robot" || name == "robots")
        .flat_map(|(_, value)| value.split(','))
        .filter_map(|robot| robot.trim().parse::<RobotId>().ok());
    for robot in robots {
        if sites.is_empty() {
            who.check_robot_name(&robot)?;
        }
        for site in &sites {
            who.check_robot(site, &robot)?;
        }
    }
    Ok(())
}

async fn check_join_token(app: &App, token: &str, who: &Credential) -> Result<(), AppError> {
    let Ok(token) = token.parse::<JoinTokenId>() else {
        return Ok(());
    };
    match app.join_token_place(token).await? {
        Some((site, Some(robot))) => who.check_robot(&site, &robot),
        Some((site, None)) => who.check_whole_site(&site),
        None => Ok(()),
    }
}

async fn check_token(app: &App, token: &str, who: &Credential) -> Result<(), AppError> {
    let Ok(token) = token.parse::<TokenId>() else {
        return Ok(());
    };
    match app.token_scope(token).await? {
        Some(scope) => who.check_scope(&scope),
        None => Ok(()),
    }
}
