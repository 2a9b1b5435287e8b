"""Label numbers of FreeSurfer, which FastSurfer, SynthSeg and SAMSEG use too.

Numbers and names are those of FreeSurfer's FreeSurferColorLUT.txt
(https://surfer.nmr.mgh.harvard.edu/fswiki/FsTutorial/AnatomicalROI/FreeSurferColorLUT, as FastSurfer distributes it):
structures in the brain, subfields of hippocampus and hypothalamus, lobules of the cerebellum, and those around the
brain whose tissue is known. Left out: 500 to 558, parts of the hippocampus, which other programs use for bone and skin.
"""

from __future__ import annotations

from functools import cache

_STRUCTURES = """
1 Left-Cerebral-Exterior, 2 Left-Cerebral-White-Matter, 3 Left-Cerebral-Cortex, 4 Left-Lateral-Ventricle, 5
Left-Inf-Lat-Vent, 6 Left-Cerebellum-Exterior, 7 Left-Cerebellum-White-Matter, 8 Left-Cerebellum-Cortex, 9
Left-Thalamus-unused, 10 Left-Thalamus, 11 Left-Caudate, 12 Left-Putamen, 13 Left-Pallidum, 14 3rd-Ventricle, 15
4th-Ventricle, 16 Brain-Stem, 17 Left-Hippocampus, 18 Left-Amygdala, 19 Left-Insula, 20 Left-Operculum, 24 CSF, 25
Left-Lesion, 26 Left-Accumbens-area, 27 Left-Substancia-Nigra, 28 Left-VentralDC, 29 Left-undetermined, 30
Left-vessel, 31 Left-choroid-plexus, 40 Right-Cerebral-Exterior, 41 Right-Cerebral-White-Matter, 42
Right-Cerebral-Cortex, 43 Right-Lateral-Ventricle, 44 Right-Inf-Lat-Vent, 45 Right-Cerebellum-Exterior, 46
Right-Cerebellum-White-Matter, 47 Right-Cerebellum-Cortex, 48 Right-Thalamus-unused, 49 Right-Thalamus, 50
Right-Caudate, 51 Right-Putamen, 52 Right-Pallidum, 53 Right-Hippocampus, 54 Right-Amygdala, 55 Right-Insula, 56
Right-Operculum, 57 Right-Lesion, 58 Right-Accumbens-area, 59 Right-Substancia-Nigra, 60 Right-VentralDC, 61
Right-undetermined, 62 Right-vessel, 63 Right-choroid-plexus, 72 5th-Ventricle, 77 WM-hypointensities, 78
Left-WM-hypointensities, 79 Right-WM-hypointensities, 80 non-WM-hypointensities, 81 Left-non-WM-hypointensities, 82
Right-non-WM-hypointensities, 85 Optic-Chiasm, 86 Left_future_WMSA, 87 Right_future_WMSA, 88 future_WMSA, 96
Left-Amygdala-Anterior, 97 Right-Amygdala-Anterior, 98 Dura, 99 Lesion, 100 Left-wm-intensity-abnormality, 101
Left-caudate-intensity-abnormality, 102 Left-putamen-intensity-abnormality, 103
Left-accumbens-intensity-abnormality, 104 Left-pallidum-intensity-abnormality, 105
Left-amygdala-intensity-abnormality, 106 Left-hippocampus-intensity-abnormality, 107
Left-thalamus-intensity-abnormality, 108 Left-VDC-intensity-abnormality, 109 Right-wm-intensity-abnormality, 110
Right-caudate-intensity-abnormality, 111 Right-putamen-intensity-abnormality, 112
Right-accumbens-intensity-abnormality, 113 Right-pallidum-intensity-abnormality, 114
Right-amygdala-intensity-abnormality, 115 Right-hippocampus-intensity-abnormality, 116
Right-thalamus-intensity-abnormality, 117 Right-VDC-intensity-abnormality, 118 Epidermis, 120 SC-Fat-Muscle, 121
Cranium, 122 CSF-SA, 123 Muscle, 125 Adipose, 126 Spinal-Cord, 129 Bone, 130 AirCavity, 131 Orbital-Fat, 134 Globe,
136 Left-Caudate-Putamen, 137 Right-Caudate-Putamen, 138 Left-Claustrum, 139 Right-Claustrum, 142 Diploe, 143
Vitreous-Humor, 146 Outer-Table, 147 Inner-Table, 155 Left-IntCapsule-Ant, 156 Right-IntCapsule-Ant, 157
Left-IntCapsule-Pos, 158 Right-IntCapsule-Pos, 159 Left-Cerebral-WM-unmyelinated, 160
Right-Cerebral-WM-unmyelinated, 161 Left-Cerebral-WM-myelinated, 162 Right-Cerebral-WM-myelinated, 163
Left-Subcortical-Gray-Matter, 164 Right-Subcortical-Gray-Matter, 165 Skull, 167 Scalp, 168 Hematoma, 170 brainstem,
171 DCG, 172 Vermis, 173 Midbrain, 174 Pons, 175 Medulla, 176 Right-Basal-Ganglia, 177 Vermis-White-Matter, 178
SCP, 179 Floculus, 180 Left-Cortical-Dysplasia, 181 Right-Cortical-Dysplasia, 182 CblumNodulus, 192
Corpus_Callosum, 193 Left-hippocampal_fissure, 194 Left-CADG-head, 195 Left-subiculum, 196 Left-fimbria, 197
Right-hippocampal_fissure, 198 Right-CADG-head, 199 Right-subiculum, 200 Right-fimbria, 201 alveus, 202
perforant_pathway, 203 parasubiculum, 204 presubiculum, 205 subiculum, 206 CA1, 207 CA2, 208 CA3, 209 CA4, 210
GC-DG, 211 HATA, 212 fimbria, 213 lateral_ventricle, 214 molecular_layer_HP, 215 hippocampal_fissure, 216
entorhinal_cortex, 217 molecular_layer_subiculum, 218 Amygdala, 219 Cerebral_White_Matter, 220 Cerebral_Cortex, 221
Inf_Lat_Vent, 222 Perirhinal, 223 Cerebral_White_Matter_Edge, 225 Ectorhinal, 226 HP_tail, 250 Fornix, 251
CC_Posterior, 252 CC_Mid_Posterior, 253 CC_Central, 254 CC_Mid_Anterior, 255 CC_Anterior, 257 CSF-ExtraCerebral,
259 Eye-Fluid, 498 wmsa, 499 other_wmsa, 600 Tumor, 601 Cbm_Left_I_IV, 602 Cbm_Right_I_IV, 603 Cbm_Left_V, 604
Cbm_Right_V, 605 Cbm_Left_VI, 606 Cbm_Vermis_VI, 607 Cbm_Right_VI, 608 Cbm_Left_CrusI, 609 Cbm_Vermis_CrusI, 610
Cbm_Right_CrusI, 611 Cbm_Left_CrusII, 612 Cbm_Vermis_CrusII, 613 Cbm_Right_CrusII, 614 Cbm_Left_VIIb, 615
Cbm_Vermis_VIIb, 616 Cbm_Right_VIIb, 617 Cbm_Left_VIIIa, 618 Cbm_Vermis_VIIIa, 619 Cbm_Right_VIIIa, 620
Cbm_Left_VIIIb, 621 Cbm_Vermis_VIIIb, 622 Cbm_Right_VIIIb, 623 Cbm_Left_IX, 624 Cbm_Vermis_IX, 625 Cbm_Right_IX,
626 Cbm_Left_X, 627 Cbm_Vermis_X, 628 Cbm_Right_X, 690 CbmWM_Gyri_Left, 691 CbmWM_Gyri_Right, 801
L_hypothalamus_anterior_inferior, 802 L_hypothalamus_anterior_superior, 803 L_hypothalamus_posterior, 804
L_hypothalamus_tubular_inferior, 805 L_hypothalamus_tubular_superior, 806 R_hypothalamus_anterior_inferior, 807
R_hypothalamus_anterior_superior, 808 R_hypothalamus_posterior, 809 R_hypothalamus_tubular_inferior, 810
R_hypothalamus_tubular_superior, 902 Artery, 911 Skin, 912 Charm-Spinal-Cord, 914 Vein, 915 Bone-Cortical, 916
Bone-Cancellous, 920 Cortical-CSF, 930 Optic-Nerve, 951 L-olfactory-bulb, 952 R-olfactory-bulb, 961 R-N.opticus,
962 L-N.opticus, 963 R-C.mammilare, 964 R-Optic-tract, 965 L-Optic-tract, 966 L-C.mammilare, 967 R-Chiasma-Opticum,
968 L-Chiasma-Opticum, 969 Ant-Commisure, 970 Third-Ventricle, 971 R-Fornix, 972 L-Fornix, 973 Epiphysis, 974
Hypophysis, 975 Infundibulum, 976 Tuberal-Region, 977 L-Med-Hypothalamus, 978 L-Lat-Hypothalamus, 979
L-Ant-Hypothalamus, 980 L-Post-Hypothalamus, 981 R-Med-Hypothalamus, 982 R-Lat-Hypothalamus, 983
R-Ant-Hypothalamus, 984 R-Post-Hypothalamus
"""

#: Regions of the Desikan-Killiany atlas: 1000 + n is the left cortex, 2000 + n the right, 3000 and 4000 + n the white
#: matter below it.
_DESIKAN = """
unknown bankssts caudalanteriorcingulate caudalmiddlefrontal corpuscallosum cuneus entorhinal fusiform
inferiorparietal inferiortemporal isthmuscingulate lateraloccipital lateralorbitofrontal lingual
medialorbitofrontal middletemporal parahippocampal paracentral parsopercularis parsorbitalis parstriangularis
pericalcarine postcentral posteriorcingulate precentral precuneus rostralanteriorcingulate rostralmiddlefrontal
superiorfrontal superiorparietal superiortemporal supramarginal frontalpole temporalpole transversetemporal insula
"""

#: Regions of the Destrieux atlas (aparc.a2009s): 11100, 12100 the cortex, 13100, 14100 the white matter.
_DESTRIEUX = """
Unknown G_and_S_frontomargin G_and_S_occipital_inf G_and_S_paracentral G_and_S_subcentral G_and_S_transv_frontopol
G_and_S_cingul-Ant G_and_S_cingul-Mid-Ant G_and_S_cingul-Mid-Post G_cingul-Post-dorsal G_cingul-Post-ventral
G_cuneus G_front_inf-Opercular G_front_inf-Orbital G_front_inf-Triangul G_front_middle G_front_sup
G_Ins_lg_and_S_cent_ins G_insular_short G_occipital_middle G_occipital_sup G_oc-temp_lat-fusifor
G_oc-temp_med-Lingual G_oc-temp_med-Parahip G_orbital G_pariet_inf-Angular G_pariet_inf-Supramar G_parietal_sup
G_postcentral G_precentral G_precuneus G_rectus G_subcallosal G_temp_sup-G_T_transv G_temp_sup-Lateral
G_temp_sup-Plan_polar G_temp_sup-Plan_tempo G_temporal_inf G_temporal_middle Lat_Fis-ant-Horizont
Lat_Fis-ant-Vertical Lat_Fis-post Medial_wall Pole_occipital Pole_temporal S_calcarine S_central
S_cingul-Marginalis S_circular_insula_ant S_circular_insula_inf S_circular_insula_sup S_collat_transv_ant
S_collat_transv_post S_front_inf S_front_middle S_front_sup S_interm_prim-Jensen S_intrapariet_and_P_trans
S_oc_middle_and_Lunatus S_oc_sup_and_transversal S_occipital_ant S_oc-temp_lat S_oc-temp_med_and_Lingual
S_orbital_lateral S_orbital_med-olfact S_orbital-H_Shaped S_parieto_occipital S_pericallosal S_postcentral
S_precentral-inf-part S_precentral-sup-part S_suborbital S_subparietal S_temporal_inf S_temporal_sup
S_temporal_transverse
"""

#: Structures that recon-all, FastSurfer and SynthSeg write into nearly every segmentation of a brain, with the same
#: ones on the right.
_LEFT_AND_RIGHT = {
    2: 41, 3: 42, 4: 43, 5: 44, 7: 46, 8: 47, 10: 49, 11: 50, 12: 51, 13: 52, 17: 53, 18: 54, 26: 58, 28: 60,
}  # fmt: skip
#: And others that are often there.
_OFTEN = {14, 15, 16, 24, 30, 31, 62, 63, 72, *range(77, 83), 85, *range(251, 256)}


@cache
def freesurfer_names() -> dict[int, str]:
    """{label: name}, from 1 to 14175."""
    pairs = (item.strip().split(" ") for item in " ".join(_STRUCTURES.split()).split(","))
    names = {int(number): name for number, name in pairs}
    for first, prefix in ((1000, "ctx-lh-"), (2000, "ctx-rh-"), (3000, "wm-lh-"), (4000, "wm-rh-")):
        names |= {first + n: prefix + region for n, region in enumerate(_DESIKAN.split())}
    for first, prefix in ((11100, "ctx_lh_"), (12100, "ctx_rh_"), (13100, "wm_lh_"), (14100, "wm_rh_")):
        names |= {first + n: prefix + region for n, region in enumerate(_DESTRIEUX.split())}
    return names | {5001: "Left-UnsegmentedWhiteMatter", 5002: "Right-UnsegmentedWhiteMatter"}


def freesurfer_sides() -> list[tuple[int, int]]:
    """(label on the left, the same structure's label on the right)."""
    return list(_LEFT_AND_RIGHT.items())


def is_usual(label: int) -> bool:
    """Whether a label occurs in the usual segmentations (aseg, aparc+aseg, wmparc, SynthSeg)."""
    return label in _LEFT_AND_RIGHT or label in _LEFT_AND_RIGHT.values() or label in _OFTEN or is_region(label)


def is_region(label: int) -> bool:
    """Whether a label is a region of the cortex or its white matter, in either atlas."""
    return 1000 <= label <= 5002 or 11100 <= label <= 14175
