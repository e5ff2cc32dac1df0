//! Network namespaces that represent computers, with links whose quality can be reduced.

use super::{skip, spandrel};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// Number of labs of this process so far. Each lab has its own namespaces and devices.
static LABS: AtomicU32 = AtomicU32::new(0);

/// Computers on one switch. Dropping the lab removes them, and their processes must end before.
pub struct Lab {
    number: u32,
    /// Name and address of each computer.
    computers: Vec<(String, String)>,
    switch: Option<(Child, ChildStdin)>,
}

/// Quality of a link in each direction.
#[derive(Clone, Copy)]
pub struct Link {
    /// Share of lost packets.
    pub loss: f64,
    /// Delay (s).
    pub delay_s: f64,
    /// Maximum deviation from the delay (s).
    pub jitter_s: f64,
}

impl Lab {
    /// Creates a lab of computers with these names. Skips the test if the machine lacks the tools
    /// or the permission.
    pub fn or_skip(names: &[&str], seed: u64) -> Option<Self> {
        let numbered = names.iter().enumerate();
        let numbered: Vec<_> = numbered
            .map(|(index, name)| (*name, format!("10.98.0.{}", index + 1)))
            .collect();
        let numbered: Vec<(&str, &str)> = numbered
            .iter()
            .map(|(name, address)| (*name, address.as_str()))
            .collect();
        Self::at_or_skip(&numbered, seed)
    }

    /// Creates a lab of computers with these names and addresses, all in one network of 256
    /// addresses. Otherwise as [`Lab::or_skip`].
    pub fn at_or_skip(computers: &[(&str, &str)], seed: u64) -> Option<Self> {
        remove_leftovers();
        match Self::new(computers, seed) {
            Ok(lab) => Some(lab),
            Err(lacking) => {
                skip(&lacking);
                None
            }
        }
    }

    fn new(computers: &[(&str, &str)], seed: u64) -> Result<Self, String> {
        let number = LABS.fetch_add(1, Ordering::Relaxed);
        let owned = |(name, address): &(&str, &str)| ((*name).to_owned(), (*address).to_owned());
        let mut lab = Self {
            number,
            computers: computers.iter().map(owned).collect(),
            switch: None,
        };
        for (name, _) in &lab.computers {
            ip(&["netns", "add", &lab.namespace(name)])?;
        }
        let devices: Vec<String> = (0..lab.computers.len())
            .map(|index| lab.device(index))
            .collect();
        lab.switch = Some(start_switch(seed, &devices)?);
        for (index, (name, address)) in lab.computers.iter().enumerate() {
            let (namespace, device) = (lab.namespace(name), &devices[index]);
            ip(&["link", "set", device, "netns", &namespace, "name", "eth0"])?;
            let inside = |arguments: &[&str]| ip(&[&["-n", &namespace], arguments].concat());
            inside(&["address", "add", &format!("{address}/24"), "dev", "eth0"])?;
            inside(&["link", "set", "lo", "up"])?;
            inside(&["link", "set", "eth0", "up"])?;
        }
        Ok(lab)
    }

    /// Returns a command of the built binary on one of the computers.
    pub fn spandrel(&self, name: &str, subcommand: &str) -> Command {
        let plain = spandrel(subcommand);
        let mut command = self.inside(name);
        command.arg(plain.get_program()).args(plain.get_args());
        for (variable, value) in plain.get_envs() {
            match value {
                Some(value) => command.env(variable, value),
                None => command.env_remove(variable),
            };
        }
        command
    }

    /// Returns a command that runs the next named program on one of the computers.
    pub fn inside(&self, name: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.namespace(name)]);
        command
    }

    /// Returns the address of a computer.
    pub fn address(&self, name: &str) -> String {
        self.computers[self.index(name)].1.clone()
    }

    /// Returns the name of the computer with an address.
    pub fn name_at(&self, address: &str) -> &str {
        let found = self.computers.iter().find(|(_, known)| known == address);
        found
            .map(|(name, _)| name.as_str())
            .unwrap_or_else(|| panic!("no computer at {address}"))
    }

    /// Sets the quality of a computer's link.
    pub fn set(&mut self, name: &str, link: Link) {
        let Link {
            loss,
            delay_s,
            jitter_s,
        } = link;
        self.tell(&format!(
            "set {} {loss} {delay_s} {jitter_s}",
            self.index(name)
        ));
    }

    /// Cuts the link of a computer.
    pub fn cut(&mut self, name: &str) {
        self.tell(&format!("cut {}", self.index(name)));
    }

    /// Restores the link of a computer.
    pub fn heal(&mut self, name: &str) {
        self.tell(&format!("heal {}", self.index(name)));
    }

    /// Returns the bytes that a computer has received and sent so far, counting whole Ethernet
    /// frames.
    pub fn bytes(&self, name: &str) -> (u64, u64) {
        let counter = |which: &str| -> u64 {
            let path = format!("/sys/class/net/eth0/statistics/{which}_bytes");
            let read = Command::new("ip")
                .args(["netns", "exec", &self.namespace(name), "cat", &path])
                .output()
                .unwrap();
            String::from_utf8(read.stdout)
                .unwrap()
                .trim()
                .parse()
                .unwrap()
        };
        (counter("rx"), counter("tx"))
    }

    fn tell(&mut self, line: &str) {
        let (_, input) = self.switch.as_mut().unwrap();
        writeln!(input, "{line}").unwrap();
    }

    fn index(&self, name: &str) -> usize {
        self.computers
            .iter()
            .position(|(known, _)| known == name)
            .unwrap_or_else(|| panic!("no computer {name}"))
    }

    fn namespace(&self, name: &str) -> String {
        format!("spandrel-{}-{}-{name}", std::process::id(), self.number)
    }

    fn device(&self, index: usize) -> String {
        format!("sp{}x{}x{index}", std::process::id(), self.number)
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        if let Some((mut switch, input)) = self.switch.take() {
            drop(input);
            let _ = switch.kill(); // also removes its devices
            let _ = switch.wait();
        }
        for (name, _) in &self.computers {
            // The first one that could not be created does not exist.
            let _ = ip(&["netns", "delete", &self.namespace(name)]);
        }
    }
}

/// Deletes the namespaces of tests that were killed.
fn remove_leftovers() {
    let Ok(listed) = Command::new("ip").args(["netns", "list"]).output() else {
        return;
    };
    for namespace in String::from_utf8_lossy(&listed.stdout)
        .lines()
        .filter_map(|line| line.split(' ').next())
    {
        let process = namespace
            .strip_prefix("spandrel-")
            .and_then(|rest| rest.split('-').next());
        if process.is_some_and(|process| !Path::new("/proc").join(process).exists()) {
            let _ = ip(&["netns", "delete", namespace]); // may be deleted already
        }
    }
}

fn ip(arguments: &[&str]) -> Result<(), String> {
    let told = format!("`ip {}`", arguments.join(" "));
    let done = Command::new("ip")
        .args(arguments)
        .output()
        .map_err(|error| format!("{told} cannot be run: {error}"))?;
    match done.status.success() {
        true => Ok(()),
        false => Err(format!(
            "{told} fails: {}",
            String::from_utf8_lossy(&done.stderr).trim()
        )),
    }
}

fn start_switch(seed: u64, devices: &[String]) -> Result<(Child, ChildStdin), String> {
    let script: PathBuf =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/support/links.py");
    let mut command = Command::new("python3");
    command
        .arg(script)
        .arg(seed.to_string())
        .args(devices)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped());
    let mut switch = command
        .spawn()
        .map_err(|error| format!("python3 cannot be run: {error}"))?;
    let (input, output) = (switch.stdin.take().unwrap(), switch.stdout.take().unwrap());
    let mut said = String::new();
    BufReader::new(output).read_line(&mut said).unwrap();
    match said.trim() {
        "ready" => Ok((switch, input)),
        _ => {
            let _ = switch.wait();
            Err("tests/support/links.py cannot make TAP devices".to_owned())
        }
    }
}
