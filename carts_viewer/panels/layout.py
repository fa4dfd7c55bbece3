"""Layout of the panels: browsing, overlay and joints on the left, tabs on the right."""

import viser

from carts_viewer.panels.browse import BrowsePanel, OverlayPanel
from carts_viewer.panels.fit import FitPanel, LivePanel
from carts_viewer.panels.frames import FramesData
from carts_viewer.panels.help import HelpPanel
from carts_viewer.panels.import_export import ExportPanel, ImportPanel
from carts_viewer.panels.inputs import Panel, PanelPage
from carts_viewer.panels.jobs import JobsPanel
from carts_viewer.panels.joints import JointsPanel, ValuesPanel
from carts_viewer.panels.optimize import CurvesPanel, FreePanel, ObjectivePanel, OptimizePanel, SettingsPanel
from carts_viewer.panels.project import HistoryPanel, MessagePanel, PeoplePanel, SavedPanel
from carts_viewer.panels.review import FindPanel, ReviewPanel
from carts_viewer.panels.script_state import ScriptState
from carts_viewer.panels.sequence import KeyframesPanel
from carts_viewer.panels.timeline import TimelineData
from carts_viewer.panels.tools import ToolPalette
from carts_viewer.session import Session, Storage
from carts_viewer.state import ViewState

_WIDTH = 312.0
"""Width of the panels on either side [px]."""


def choose_theme(gui: viser.GuiApi, *, light: bool) -> None:
    """Set the theme of one tab, or of all tabs if `gui` is that of the server."""
    gui.configure_theme(dark_mode=not light, show_share_button=False, show_logo=False)


class Layout:
    """All panels of a page.

    Attributes:
        panels: panels in the order in which they are updated.
        joints: panel of the joint sliders.
        timeline: data of the timeline below the image.
    """

    def __init__(self, page: PanelPage, session: Session, storage: Storage, state: ViewState) -> None:
        gui = page.gui
        gui.set_panel_label("CaRTS")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(_WIDTH)
        panels: list[Panel] = [
            SavedPanel(page, storage),
            MessagePanel(page),
            FitPanel(page, session),
            BrowsePanel(page, session),
            OverlayPanel(page, session, state),
        ]
        with gui.add_folder("Joints"):
            self.joints = JointsPanel(page, session, state)
        right = gui.add_panel()
        with right.add_tab("Optimize"):
            panels += [
                OptimizePanel(page, session),
                CurvesPanel(gui),
                ObjectivePanel(page, session, state),
                SettingsPanel(page, state),
                FreePanel(page, session, state),
            ]
        with right.add_tab("Review"):
            panels += _review(page, session, state)
        with right.add_tab("Values"):
            panels.append(ValuesPanel(gui, session))
        with right.add_tab("Jobs"):
            panels.append(JobsPanel(page))
        with right.add_tab("Live"):
            panels.append(LivePanel(page))
        with right.add_tab("Export"):
            panels.append(ExportPanel(page, session, storage))
        panels.append(HelpPanel(page, self.joints.perturb))
        right.dock_right()
        right.set_width(_WIDTH)
        self.timeline = TimelineData(page, session)
        self.panels = [
            *panels,
            self.joints,
            ScriptState(page, session),
            ToolPalette(page, session),
            self.timeline,
            FramesData(page),
        ]


def _review(page: PanelPage, session: Session, state: ViewState) -> list[Panel]:
    """Panels of reviews, keyframes, imports and history."""
    return [
        ReviewPanel(page),
        KeyframesPanel(page, session),
        ImportPanel(page, session),
        FindPanel(page, session),
        HistoryPanel(page),
        PeoplePanel(page, state),
    ]
