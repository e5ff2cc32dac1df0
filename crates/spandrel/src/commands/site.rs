//! `spandrel site`: creates the authority of a site, certificates for its parties, and the
//! configuration of its router.

use super::{counted, print};
use crate::cli::{SiteCommand, SiteRouterArguments};
use crate::error::AppError;
use spandrel_access::{
    AccessError, Existing, Issued, Party, Role, RouterPlan, SiteFolder, router_file,
};
use spandrel_bus::{AUTHORITY_FILE, DEFAULT_ROOT, Name};
use spandrel_checkpoint::sync_name;
use spandrel_structure::Structure;
use std::fmt::Write as _;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// File name of the router's configuration in the folder of a site.
const ROUTER_FILE: &str = "router.json5";

/// Runs a command on the folder of a site.
///
/// # Errors
/// Returns an error if a file already exists, a name or file is not valid, or a file cannot be
/// written.
pub fn run(command: SiteCommand) -> Result<(), AppError> {
    match command {
        SiteCommand::Create {
            folder,
            name,
            days,
            replace,
        } => {
            let name = Name::new(name)?;
            let (_, authority) =
                SiteFolder::create(&folder, name.as_str(), days, existing(replace))?;
            print(&told(&authority))?;
            print("keep the key of the authority on a machine outside the site network\n")
        }
        SiteCommand::Issue {
            folder,
            role,
            name,
            host,
            days,
            replace,
        } => {
            let party = Party::new(role, &name).map_err(AccessError::from)?;
            let issued =
                SiteFolder::open(&folder)?.issue(&party, &host, days, existing(replace))?;
            print(&told(&issued))
        }
        SiteCommand::Nodes {
            folder,
            structures,
            days,
        } => issue_to_nodes(&folder, &structures, days),
        SiteCommand::Router(arguments) => write_router_file(&arguments),
    }
}

fn existing(replace: bool) -> Existing {
    if replace {
        Existing::Replace
    } else {
        Existing::Keep
    }
}

fn told(issued: &Issued) -> String {
    let Issued {
        certificate,
        key,
        expires,
    } = issued;
    format!(
        "{}, {}: valid until {expires}\n",
        certificate.display(),
        key.display()
    )
}

/// Returns the parties of a structure's nodes: sensors, and also workers in distributed
/// identification.
fn nodes_of(structure: &Structure) -> Result<Vec<Party>, AppError> {
    let roles: &[Role] = if structure.fusion().is_some() {
        &[Role::Sensor, Role::NodeWorker]
    } else {
        &[Role::Sensor]
    };
    let mut parties = Vec::new();
    for node in structure.nodes() {
        for role in roles {
            let name = format!("{}.{}", structure.name(), node.name());
            parties.push(Party::new(*role, &name).map_err(AccessError::from)?);
        }
    }
    Ok(parties)
}

fn issue_to_nodes(folder: &Path, structures: &[PathBuf], days: u32) -> Result<(), AppError> {
    let site = SiteFolder::open(folder)?;
    let known = site.parties()?;
    for path in structures {
        for party in nodes_of(&Structure::read(path)?)?
            .into_iter()
            .filter(|party| !known.contains(party))
        {
            print(&told(&site.issue(&party, &[], days, Existing::Keep)?))?;
        }
    }
    Ok(())
}

fn write_router_file(arguments: &SiteRouterArguments) -> Result<(), AppError> {
    let site = SiteFolder::open(&arguments.folder)?;
    let structures = arguments
        .structures
        .iter()
        .map(|path| Structure::read(path))
        .collect::<Result<Vec<_>, _>>()?;
    let parties = site.parties()?;
    check_names(&parties, &structures)?;
    let router = site.router(arguments.router.as_deref())?;
    let root = Name::new(arguments.root.as_deref().unwrap_or(DEFAULT_ROOT))?;
    let folder = match &arguments.installed_in {
        Some(folder) => folder.clone(),
        None => std::path::absolute(&arguments.folder).map_err(|source| AppError::Io {
            what: format!(
                "{}: cannot determine the absolute path",
                arguments.folder.display()
            ),
            source,
        })?,
    };
    let at = |file: &str| folder.join(file);
    let common_name = router.common_name();
    let text = router_file(&RouterPlan {
        root: &root,
        router: &router,
        listen: &arguments.listen,
        connect: &arguments.connect,
        certificate: &at(&format!("{common_name}.pem")),
        key: &at(&format!("{common_name}.key")),
        authority: &at(AUTHORITY_FILE),
        parties: &parties,
    })?;
    let output = arguments
        .output
        .clone()
        .unwrap_or_else(|| arguments.folder.join(ROUTER_FILE));
    if output.exists() && !arguments.replace {
        return Err(AccessError::Exists { path: output }.into());
    }
    let written = File::create(&output).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_all()
    });
    written.map_err(|source| AccessError::File {
        what: "written",
        path: output.clone(),
        source,
    })?;
    sync_name(&output);
    print(&summary(&output, &parties, &structures)?)
}

/// Rejects certificates of unknown structures and nodes. A misspelt name would otherwise only cause
/// silence.
fn check_names(parties: &[Party], structures: &[Structure]) -> Result<(), AppError> {
    for party in parties {
        let Some(name) = party.structure() else {
            continue;
        };
        let Some(structure) = structures
            .iter()
            .find(|structure| structure.name() == name.as_str())
        else {
            let known: Vec<&str> = structures.iter().map(Structure::name).collect();
            return Err(AppError::CertificateOfNone {
                party: party.common_name(),
                known: known.join(", "),
            });
        };
        let is_node = |node: &Name| {
            structure
                .nodes()
                .iter()
                .any(|known| known.name() == node.as_str())
        };
        if let Some(node) = party.node().filter(|node| !is_node(node)) {
            let known: Vec<&str> = structure.nodes().iter().map(|node| node.name()).collect();
            let (structure, name) = (structure.name().to_owned(), node.to_string());
            return Err(AppError::UnknownNode {
                structure,
                name,
                known: known.join(", "),
            });
        }
    }
    Ok(())
}

fn summary(output: &Path, parties: &[Party], structures: &[Structure]) -> Result<String, AppError> {
    let is_on_the_bus = |party: &&Party| !matches!(party.role(), Role::Router | Role::Database);
    let admitted = parties.iter().filter(is_on_the_bus).count();
    let mut text = format!(
        "{}: {} may connect\n",
        output.display(),
        counted(admitted, "party", "parties")
    );
    for structure in structures {
        let is_a_gateway = |party: &&Party| {
            party.role() == Role::Gateway
                && party
                    .structure()
                    .is_some_and(|name| name.as_str() == structure.name())
        };
        let missing: Vec<String> = nodes_of(structure)?
            .into_iter()
            .filter(|party| !parties.contains(party))
            .map(|party| party.common_name())
            .collect();
        if !missing.is_empty() && parties.iter().find(is_a_gateway).is_none() {
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "without a certificate: {} (spandrel site nodes issues them)",
                missing.join(", ")
            );
        }
    }
    Ok(text + "restart a running router to apply the file\n")
}
