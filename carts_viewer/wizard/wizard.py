"""New recording: choose files, check guesses, click points, calibrate, save. Drafts are saved after each change."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from carts_core.errors import CartsError, SettingsError
from carts_core.model.scene import Scene
from carts_core.recording import TimeOffsetEstimate
from carts_core.recording.video import SUFFIXES
from carts_viewer.start.host import FileBrowser, Host
from carts_viewer.start.roots import Entry
from carts_viewer.transport.document import render
from carts_viewer.wizard.check import Guess, check_form, estimated_delay, guess, open_recording, previews, problem_of
from carts_viewer.wizard.draft import Draft, DraftFile, Step, changed, picked
from carts_viewer.wizard.hand_eye import HandEyeStep
from carts_viewer.wizard.points import ClickPrompt

_SOURCES = (*SUFFIXES, ".bag", ".mcap", ".parquet")
_TABLES = (".csv", ".txt", ".tsv", ".parquet", ".npy", ".npz")
_CALIBRATIONS = (".yaml", ".yml", ".mat", ".json", ".ini", ".txt")
_PURPOSES = {
    "source": ("Choose the folder of the recording: images or videos, and a table of joints.", _SOURCES, True),
    "images": ("Choose a folder of images, or a video.", SUFFIXES, True),
    "calibration": ("Choose the camera's calibration (ROS, OpenCV, Kalibr, MATLAB).", _CALIBRATIONS, False),
    "kinematics": ("Choose the table of joint positions or tip poses.", _TABLES, False),
    "robot": ("Choose the URDF of the instrument; carts robot generates one.", (".urdf",), False),
}
_MAX_UNDO = 200


class RecordingWizard:
    """The page *New recording* with its draft."""

    def __init__(self, host: Host, key: str | None = None) -> None:
        self._host = host
        self._problem = ""
        self._part = "source"
        self._browser: FileBrowser | None = None
        self._undo: list[Draft] = []
        self._guess: Guess | None = None
        self._delay: TimeOffsetEstimate | None = None
        self._pictures: dict[str, list[tuple[str, str]]] = {}
        self._step: HandEyeStep | None = None
        try:
            self._file = DraftFile(key)
            self._draft = self._file.read()
        except CartsError as error:
            self._file, self._draft, self._problem = DraftFile(), Draft(), str(error)
        if not self._draft.source:
            self._browse("source")

    @property
    def draft(self) -> Draft:
        """The draft: all choices so far."""
        return self._draft

    @property
    def prompt(self) -> ClickPrompt | None:
        """The next prompt; None if there is none."""
        return None if self._step is None else self._step.prompt(self._draft)

    @property
    def shown_scene(self) -> Scene | None:
        """The scene shown by the overlay; None if there is no overlay."""
        return None if self._step is None else self._step.shown_scene(self._draft)

    def show(self) -> None:
        """Update the document."""
        if self._draft.step is Step.HAND_EYE and self._enter_hand_eye():
            assert self._step is not None
            try:
                self._step.show(self._draft, undoable=bool(self._undo))
                return
            except (CartsError, LookupError, TypeError, ValueError) as error:
                self._leave_hand_eye()
                self._problem = f"The points or calibration of this import do not match the recording: {error}"
                self._change(self._draft.uncalibrated(step=Step.CHECK))
        self._host.document.show(self._page())

    def choose(self, name: str, value: str) -> None:
        """Apply a choice."""
        self._problem = ""
        steps = {"continue": Step.HAND_EYE, "back": Step.CHECK}
        if name == "leave":
            return self._host.show_start()
        if name == "delete":
            return self._delete()
        if name in steps:
            self._set(replace(self._draft, step=steps[name]))
        elif name == "undo":
            self._undo_step()
        elif not self._browsed(name, value):
            if self._step is not None and self._draft.step is Step.HAND_EYE:
                return self._in_hand_eye(name, value)
            self._check(name, value)
        self.show()

    def _browsed(self, name: str, value: str) -> bool:
        """Apply a choice of the file browser; returns whether it is one."""
        browser = self._browser
        match name:
            case "change":
                self._browse(value)
            case "close-browser":
                self._browser = None
            case "browse" if browser is not None:
                browser.browse(value)
            case "pick" if browser is not None:
                self._pick(browser.picked(value))
            case _:
                return False
        return True

    def _check(self, name: str, value: str) -> None:
        """Apply a choice of the step Check."""
        delay = self._delay
        match name:
            case "estimate-delay":
                self._estimate_delay()
            case "accept-delay" if delay is not None and delay.proposed is not None:
                self._set(changed(self._draft, "time_offset", str(delay.proposed), {}) or self._draft)
            case "trial":
                if (trial := next((each for each in self._guessed().trials if str(each) == value), None)) is not None:
                    self._set(picked(self._draft, "source", self._host.roots.checked(trial), {}))
            case _:
                columns = self._guess.columns if self._guess else {}
                self._set(changed(self._draft, name, value, columns) or self._draft)

    def click(self, u: float, v: float) -> None:
        """Place the prompted point."""
        if self._step is not None and self._draft.step is Step.HAND_EYE:
            self._problem = ""
            self._set(self._step.clicked(self._draft, u, v))
            self.show()

    def fail(self, error: Exception) -> None:
        """Show an error."""
        self._problem = (problem_of(error) if isinstance(error, CartsError) else str(error)) or type(error).__name__
        if self._step is not None:
            self._step.problem = self._problem
        self.show()

    def close(self) -> None:
        """Stop running work; the draft is already saved."""
        self._leave_hand_eye()

    def _set(self, draft: Draft) -> None:
        """Replace the draft as an undo step."""
        if draft == self._draft:
            return
        self._undo = [*self._undo, self._draft][-_MAX_UNDO:]
        self._change(draft)

    def _change(self, draft: Draft) -> None:
        anew = (draft.source, draft.options) != (self._draft.source, self._draft.options)
        self._draft = draft
        if anew:
            self._guess = self._delay = None
        if anew or draft.step is not Step.HAND_EYE:
            self._leave_hand_eye()
        self._file.write(draft)

    def _undo_step(self) -> None:
        if self._undo:
            before = self._undo.pop()
            self._change(before)
            if not before.source:
                self._file.delete()
                self._browse("source")

    def _delete(self) -> None:
        self._file.delete()
        self._draft = Draft()
        self._host.show_start()

    def _browse(self, part: str) -> None:
        """Open the file browser for a part of the recording."""
        kind = part.partition(" ")[0]
        if kind not in _PURPOSES:
            raise SettingsError(f"a recording has no part {kind!r}.")
        purpose, suffixes, folders = _PURPOSES[kind]

        def wanted(entry: Entry) -> bool:
            return entry.path.suffix.lower() in suffixes

        self._part = part
        self._browser = FileBrowser(self._host.roots, wanted=wanted, folders=folders, purpose=purpose)
        if self._draft.source and kind != "source":
            source = Path(self._draft.source)
            self._browser.begin_in(source if source.is_dir() else source.parent)

    def _pick(self, path: Path | None) -> None:
        if path is None:
            return
        recording = None if self._guess is None else self._guess.recording
        found = {} if recording is None else {camera.name: camera.images for camera in recording.cameras}
        self._set(picked(self._draft, self._part, path, found))
        self._browser = None

    def _page(self) -> str:
        """HTML of the steps Files and Check."""
        values = {"steps": Step, "browser": self._browser, "draft": self._draft, "problem": self._problem}
        if self._browser is not None:
            return render("recording.html", step=Step.FILES, **values)
        found = self._guessed()
        form = check_form(self._draft, found, self._pictures, self._delay)
        return render("recording.html", step=Step.CHECK, guess=found, form=form, undoable=bool(self._undo), **values)

    def _guessed(self) -> Guess:
        """Content of the files, cached until the choices change."""
        if self._guess is None:
            if not self._pictures:
                self._show_message(self._draft.name, "Reading the recording …")
            self._guess, self._pictures = guess(self._draft), {}
            if self._guess.recording is not None:
                with suppress(CartsError):
                    self._add_pictures(self._guess)
        return self._guess

    def _show_message(self, title: str, text: str, place: str = "page") -> None:
        self._host.document.show(render("message.html", title=title, text=text), place)

    def _estimate_delay(self) -> None:
        """Estimate the delay from the motion in images and table."""
        recording = self._guessed().recording
        if recording is not None:
            self._show_message("Time", "Comparing the motion in the images with the table …")
            self._delay = estimated_delay(recording)

    def _add_pictures(self, found: Guess) -> None:
        assert found.recording is not None
        sequence, folder = open_recording(found.recording)
        with folder:
            for camera in sequence.scene.cameras:
                images = previews(sequence, camera.name)
                publish = self._host.page.media.publish
                self._pictures[camera.name] = [(frame, publish(jpeg)) for frame, jpeg in images]

    def _enter_hand_eye(self) -> bool:
        """Open the recording for the step Hand-eye; returns whether this succeeded."""
        if self._step is None:
            found = self._guessed()
            try:
                if found.recording is None or found.problems:
                    raise SettingsError(next(iter(found.problems.values()), "the recording cannot be read."))
                self._show_message("Hand-eye", "Opening the images …", "side")
                self._step = HandEyeStep(self._host, found.recording, self._draft, self._calibrated)
            except CartsError as error:
                self._problem = problem_of(error)
                self._change(replace(self._draft, step=Step.CHECK))
                return False
        return True

    def _leave_hand_eye(self) -> None:
        step, self._step = self._step, None
        if step is not None:
            step.close()

    def _in_hand_eye(self, name: str, value: str) -> None:
        assert self._step is not None
        if name == "save":
            path = self._step.write(self._draft)
            self._file.delete()
            self._host.open_sequence(path)
            return
        self._set(self._step.chosen(self._draft, name, value))
        self.show()

    def _calibrated(self, draft_change: Callable[[Draft], Draft]) -> None:
        """Apply a calibration's progress or result; called on the site's thread."""
        if self._step is not None and self._draft.step is Step.HAND_EYE:
            self._set(draft_change(self._draft))
            self.show()
