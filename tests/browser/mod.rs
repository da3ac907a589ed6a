//! Headless Chromium, driven through its debugging pipe (Chrome DevTools Protocol). It gets real events of mouse, keys
//! and touch, and records every request, console message and exception.

#![allow(dead_code, reason = "every test crate compiles this module and uses a part of it")]

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use serde_json::{Value, json};
use splatsieve::render::Image;
use tempfile::TempDir;

const NAMES: [&str; 5] =
    ["chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
/// Maximum time to wait for an answer of the browser. Without a graphics card, the processor computes WebGL.
const PATIENCE: Duration = Duration::from_secs(240);

/// Returns the browser to use: `SPLATSIEVE_BROWSER`, else an installed one. Panics if there is none.
pub(crate) fn installed() -> PathBuf {
    if let Some(given) = std::env::var_os("SPLATSIEVE_BROWSER") {
        return PathBuf::from(given);
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = NAMES.iter().flat_map(|name| std::env::split_paths(&path).map(move |folder| folder.join(name)));
    let found = found.into_iter().find(|file| file.is_file());
    found.expect("an installed Chromium (apt-get install chromium-headless-shell)")
}

/// Returns the image of `width` × `height` pixels whose red, green and blue are `rgb`, row by row from the top left.
pub(crate) fn image_from_bytes(width: u32, height: u32, rgb: &[u8]) -> Image {
    Image { width, height, data: rgb.iter().map(|&byte| f32::from(byte) / 255.0).collect() }
}

/// Running browser with one page.
pub(crate) struct Browser {
    process: Child,
    to: File,
    from: Receiver<Value>,
    session: String,
    last: u64,
    /// Events that the browser sent, in order.
    pub(crate) events: Vec<Value>,
    _home: TempDir,
}

impl Browser {
    /// Starts the browser `program` with an empty page of 1100 × 900 pixels, without graphics acceleration.
    pub(crate) fn start(program: &Path) -> Browser {
        Browser::with(program, &["--disable-gpu"])
    }

    /// Starts the browser `program` with WebGL. The processor computes it if there is no graphics card.
    pub(crate) fn start_drawing(program: &Path) -> Browser {
        Browser::with(program, &["--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
    }

    fn with(program: &Path, graphics: &[&str]) -> Browser {
        let home = tempfile::tempdir().unwrap();
        let pipes = ["to", "from"].map(|name| home.path().join(name));
        assert!(Command::new("mkfifo").args(&pipes).status().unwrap().success());
        let mut shell = Command::new("sh");
        // The browser expects its pipe as descriptors 3 and 4.
        shell.arg("-c").arg("exec \"$@\" 3<\"$TO\" 4>\"$FROM\"").arg("sh").arg(program);
        shell.args(["--headless", "--no-sandbox", "--remote-debugging-pipe", "--disable-dev-shm-usage"]).args(graphics);
        shell.arg("--window-size=1100,900").arg(format!("--user-data-dir={}", home.path().display()));
        shell.env("TO", &pipes[0]).env("FROM", &pipes[1]).env("HOME", home.path());
        let process = shell.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let to = File::options().write(true).open(&pipes[0]).unwrap();
        let mut replies = BufReader::new(File::open(&pipes[1]).unwrap());
        let (send, from) = channel();
        std::thread::spawn(move || {
            let mut message = Vec::new();
            while replies.read_until(0, &mut message).is_ok_and(|read| read > 0) {
                message.pop();
                let _ = send.send(serde_json::from_slice(&message).unwrap_or_default());
                message.clear();
            }
        });
        let mut browser =
            Browser { process, to, from, session: String::new(), last: 0, events: Vec::new(), _home: home };
        let target = browser.ask("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let session = browser.ask("Target.attachToTarget", attach);
        browser.session = session["sessionId"].as_str().unwrap().to_owned();
        for domain in ["Page", "Runtime", "Log", "Network"] {
            browser.ask(&format!("{domain}.enable"), json!({}));
        }
        browser
    }

    /// Sends the command `method` with `parameters` to the browser and returns its result.
    pub(crate) fn ask(&mut self, method: &str, parameters: Value) -> Value {
        self.last += 1;
        let mut message = json!({ "id": self.last, "method": method, "params": parameters });
        if !self.session.is_empty() {
            message["sessionId"] = json!(self.session);
        }
        let mut bytes = message.to_string().into_bytes();
        bytes.push(0);
        self.to.write_all(&bytes).unwrap();
        loop {
            let reply = self.from.recv_timeout(PATIENCE).unwrap_or_else(|e| panic!("{method}: the browser {e}"));
            if reply["id"] == self.last {
                assert!(reply.get("error").is_none(), "{method}: {}", reply["error"]);
                return reply["result"].clone();
            }
            self.events.push(reply);
        }
    }

    /// Opens the file `page` in the browser and waits until it is fully loaded.
    pub(crate) fn open(&mut self, page: &Path) {
        let page = fs::canonicalize(page).unwrap();
        self.ask("Page.navigate", json!({ "url": format!("file://{}", page.display()) }));
        while !self.events.iter().any(|event| event["method"] == "Page.loadEventFired") {
            let event = self.from.recv_timeout(PATIENCE).expect("the page never finished loading");
            self.events.push(event);
        }
    }

    /// Evaluates a JavaScript expression in the page and returns its value. If the value is a promise, waits for its
    /// result.
    pub(crate) fn value(&mut self, expression: &str) -> Value {
        let mut parameters = json!({ "expression": expression, "returnByValue": true });
        parameters[concat!("await", "Promise")] = json!(true);
        let found = self.ask("Runtime.evaluate", parameters);
        assert!(found.get("exceptionDetails").is_none(), "{expression}: {}", found["exceptionDetails"]);
        found["result"]["value"].clone()
    }

    /// Presses the mouse button at the first point, moves the mouse to the other points and releases the button at the
    /// last.
    pub(crate) fn drag(&mut self, points: &[[f64; 2]]) {
        let mut send = |kind: &str, [x, y]: [f64; 2], buttons: u32| {
            let event = json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": buttons, "clickCount": 1 });
            self.ask("Input.dispatchMouseEvent", event);
        };
        send("mousePressed", points[0], 1);
        for &point in &points[1..] {
            send("mouseMoved", point, 1);
        }
        send("mouseReleased", points[points.len() - 1], 0);
    }

    /// Simulates touch. Each entry of `steps` has the points of all fingers. The fingers touch the screen at the first
    /// entry, move to the others, and leave the screen.
    pub(crate) fn touch(&mut self, steps: &[Vec<[f64; 2]>]) {
        let mut send = |kind: &str, points: &[[f64; 2]]| {
            let points: Vec<Value> =
                points.iter().enumerate().map(|(id, [x, y])| json!({ "x": x, "y": y, "id": id })).collect();
            self.ask("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
        };
        send("touchStart", &steps[0]);
        for points in &steps[1..] {
            send("touchMove", points);
        }
        send("touchEnd", &[]);
    }

    /// Gives the browser a screen of `width` × `height` pixels. `scheme` is `light` or `dark`, the color scheme that
    /// the page is told the user prefers.
    pub(crate) fn screen(&mut self, width: u32, height: u32, scheme: &str) {
        let is_phone = width < 600;
        let device = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_phone });
        self.ask("Emulation.setDeviceMetricsOverride", device);
        let features = json!([{ "name": "prefers-color-scheme", "value": scheme }]);
        self.ask("Emulation.setEmulatedMedia", json!({ "features": features }));
    }

    /// Returns the serious violations of accessibility rules in the page. The script `axe` (axe-core) finds them.
    pub(crate) fn serious_violations(&mut self, axe: &str) -> Vec<String> {
        self.ask("Runtime.evaluate", json!({ "expression": axe }));
        let found = self.value(
            "axe.run(document, { resultTypes: ['violations'] }).then(found => found.violations\
             .filter(rule => ['serious', 'critical'].includes(rule.impact))\
             .map(rule => `${rule.id}: ${rule.nodes.map(node => node.html.slice(0, 200)).join(' | ')}`))",
        );
        serde_json::from_value(found).unwrap()
    }

    /// Presses and releases the key `name`, such as `ArrowLeft`, which enters no text. `code` is the virtual key code
    /// of this key on Windows.
    pub(crate) fn key(&mut self, name: &str, code: u32) {
        for kind in ["rawKeyDown", "keyUp"] {
            let event = json!({ "type": kind, "key": name, "code": name, "windowsVirtualKeyCode": code });
            self.ask("Input.dispatchKeyEvent", event);
        }
    }

    /// Returns the faults of the page so far: exceptions, console messages, and requests for anything but the page and
    /// its data URIs.
    pub(crate) fn complaints(&self) -> Vec<String> {
        let complaint = |event: &Value| {
            let about = &event["params"];
            match event["method"].as_str()? {
                "Runtime.exceptionThrown" => Some(format!("exception: {}", about["exceptionDetails"])),
                "Runtime.consoleAPICalled" => Some(format!("console: {}", about["args"])),
                "Log.entryAdded" => Some(format!("log: {}", about["entry"]["text"])),
                "Network.requestWillBeSent" => {
                    let url = about["request"]["url"].as_str()?;
                    let itself = about["type"] == "Document" && url.starts_with("file://");
                    (!itself && !url.starts_with("data:")).then(|| format!("request: {url}"))
                }
                _ => None,
            }
        };
        self.events.iter().filter_map(complaint).collect()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
